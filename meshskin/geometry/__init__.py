"""Bodies: checked meshes, the smooth surface on them, regions and skin layouts."""
