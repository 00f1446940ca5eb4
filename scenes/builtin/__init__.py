"""The scenes that come with sulcus, one file each: copy one to add yours."""
