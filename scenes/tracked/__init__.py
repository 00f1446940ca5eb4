"""A real or drawn film in, an overlay out."""
