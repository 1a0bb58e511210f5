"""The examples in docstrings run as they stand."""

import doctest
import importlib
import pkgutil

import pytest

import jaxreg


def _examples() -> list[doctest.DocTest]:
    found = {}
    for module in pkgutil.walk_packages(jaxreg.__path__, "jaxreg."):
        if module.name == "jaxreg.__main__":
            continue
        for test in doctest.DocTestFinder().find(importlib.import_module(module.name)):
            if test.examples:
                found[test.name] = test
    return list(found.values())


EXAMPLES = _examples()


def test_what_people_call_first_has_an_example():
    names = {test.name.split(".")[-1] for test in EXAMPLES}
    assert {"register", "average", "from_edges", "read_points", "draw"} <= names


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda test: test.name)
def test_example(example: doctest.DocTest, capsys: pytest.CaptureFixture[str]):
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    result = runner.run(example)
    assert result.failed == 0, capsys.readouterr().out
