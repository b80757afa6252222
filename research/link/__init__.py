"""Images over a lossy acoustic link, by transmission scheme."""
