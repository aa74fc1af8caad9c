"""The smooth surface of a mesh: jets, creases, patches, closest points."""
