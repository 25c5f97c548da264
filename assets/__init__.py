"""Data files: the robots' MJCF."""
