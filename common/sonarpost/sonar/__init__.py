"""Side-scan surveys: readers, pings with navigation, geometry, ground range, image files."""
