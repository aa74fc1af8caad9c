"""Triangle meshes: checks, repairs, inside and outside."""
