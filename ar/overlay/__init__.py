"""What is drawn over the picture: the hidden surface, in each style, its lines and its words."""
