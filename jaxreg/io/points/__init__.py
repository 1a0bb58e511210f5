"""Point sets in files, one format a file."""
