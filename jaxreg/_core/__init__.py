"""Vocabulary, statuses and checks that every other room of the package uses."""
