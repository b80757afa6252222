"""Survey files or snippets to contacts."""
