"""The tetrahedral meshes of the falling objects: shapes, the script that meshes them, and its results as data."""
