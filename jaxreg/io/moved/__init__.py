"""Files of points written again, moved: one format a file, all else as it was."""
