"""What the joint estimate is made of, one kind of knowledge a file."""
