"""What happens: scripted tools, the loop that plays them, and the command line."""
