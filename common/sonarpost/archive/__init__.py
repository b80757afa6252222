"""Images and decisions on disk: files, side-cars, and the index of the shore site."""
