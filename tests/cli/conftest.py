"""What tests of commands share."""

import pytest

from gsplat_edu.cli.main import main


@pytest.fixture
def convert(capsys):
    """Run `convert`; return what it printed, or the one line of its refusal."""

    def call(*words, code=0):
        try:
            assert main(["convert", *map(str, words)]) == code
        except SystemExit as stop:  # argparse exits by itself
            assert stop.code == code
        printed = capsys.readouterr()
        if code:
            assert code == 2 and printed.err.count("\n") == 1 and "Traceback" not in printed.err
        return printed.err if code else printed.out

    return call
