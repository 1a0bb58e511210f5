"""The list of mutants fits the package: see `mutants.py`, which runs them."""

from mutants import faults, mutants


def test_every_mutant_is_of_one_line_and_names_tests_that_there_are():
    found = mutants()
    assert not faults(found)
    assert len(found) >= 60
