"""What several research commands use: images, measurement, statistics, plots."""
