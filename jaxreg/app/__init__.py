"""What serves people: the command line, pictures, pages and results; extra `app`."""
