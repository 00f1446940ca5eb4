"""Built-in scenes, one file each: copy one to add your own."""
