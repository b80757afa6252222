"""Survey readers, one module a format, and the registry that picks one by file suffix."""
