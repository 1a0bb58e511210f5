"""The command line; needs the extra `app`."""
