"""Extensions: features that a deployment may lack. Each is one folder that nothing outside it imports.

`entry_points.toml` in the folder of an extension names what it adds, by group and name, as the entry points of another
package do: see `sonarpost.registry`. Deleting the folder removes the feature.
"""
