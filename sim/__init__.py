"""What tissue does: meshes, laws, loads, and the finite elements that answer them."""
