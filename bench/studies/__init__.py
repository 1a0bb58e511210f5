"""Studies behind choices of the library: scripts, and what they said."""
