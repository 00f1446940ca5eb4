"""Demo page: display of a scene, its deformers, and the requests of users."""
