"""Survey readers and writers, geometry, snippets and image files."""
