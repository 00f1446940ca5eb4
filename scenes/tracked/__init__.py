"""Tumour overlay on real or rendered videos with tracked tools, and files of real cameras and trackers."""
