"""From an image, a label volume, the template or a file to an anatomy."""
