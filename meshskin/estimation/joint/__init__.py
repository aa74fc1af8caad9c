"""Joint maximum likelihood: all readings of all contacts and all unknowns at once."""
