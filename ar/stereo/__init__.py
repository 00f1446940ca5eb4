"""What two eyes see: rows made alike, depths, points that are followed."""
