"""Every public name shows what it does, by an example that runs and ends in a number."""

import doctest

import numpy as np
import pytest

import colorphase

OPTIONS = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
pytestmark = pytest.mark.usefixtures("cpu")


@pytest.mark.filterwarnings("ignore::pipeline.DecodeWarning")
@pytest.mark.parametrize("name", colorphase.__all__)
def test_the_example_of(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    thing = getattr(colorphase, name)
    tests = doctest.DocTestFinder(recurse=True).find(thing, name, globs={"colorphase": colorphase, "np": np})
    examples = [example for test in tests for example in test.examples]
    assert any(character.isdigit() for example in examples for character in example.want), f"{name} has no example"
    said = []
    for test in tests:
        doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append)
    assert not said, "".join(said)
