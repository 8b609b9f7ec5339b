"""Every public name shows what it does, by an example that runs and ends in a number."""

import doctest

import numpy as np
import pytest

import colorphase

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.mark.filterwarnings("ignore::pipeline.DecodeWarning")
@pytest.mark.parametrize("name", colorphase.__all__)
def test_the_example_of(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    thing = getattr(colorphase, name)
    tests = doctest.DocTestFinder(recurse=True).find(thing, name, globs={"colorphase": colorphase, "np": np})
    examples = [example for test in tests for example in test.examples]
    shows_a_number = any(character.isdigit() for example in examples for character in example.want)
    is_error = isinstance(thing, type) and issubclass(thing, Exception)
    assert is_error or shows_a_number, f"{name} has no example"  # many an error needs an instrument that is broken
    said = []
    for test in tests:
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=said.append)
    assert not said, "".join(said)
