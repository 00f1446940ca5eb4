"""A real or drawn film in, an overlay out; the files of a real camera."""
