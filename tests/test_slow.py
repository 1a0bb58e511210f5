"""What `slow.txt` names is there."""

from pathlib import Path


HERE = Path(__file__).parent
NAMES = [
    line
    for line in (HERE / "slow.txt").read_text().splitlines()
    if not line.startswith("#")
]


def test_the_list_is_in_order_and_names_each_once():
    assert NAMES == sorted(set(NAMES))


def test_files_and_functions_are_there():
    for name in NAMES:
        file, _, test = name.partition("::")
        function = test.partition("[")[0]
        assert f"\ndef {function}(" in (HERE / file).read_text(), name
