"""What `import colorphase` offers."""

import pickle

import pytest

import colorphase
import hardware.errors
import pipeline.errors
import tikernels.errors
from tikernels.errors import Error


def test_all_public_names_are_there():
    assert sorted(set(colorphase.__all__)) == sorted(colorphase.__all__)
    for name in colorphase.__all__:
        assert callable(getattr(colorphase, name)), name
    assert {*colorphase.__all__, "__version__"} <= set(dir(colorphase))
    with pytest.raises(AttributeError, match="module 'colorphase' has no attribute 'decoder'"):
        _ = colorphase.decoder


@pytest.mark.parametrize("errors", [hardware.errors, pipeline.errors, tikernels.errors])
def test_every_error_is_public(errors):
    defined = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert defined <= set(colorphase.__all__)


@pytest.mark.parametrize("errors", [hardware.errors, pipeline.errors, tikernels.errors])
def test_every_error_is_one_of_ours_and_of_pythons_and_crosses_processes(errors):
    for kind in vars(errors).values():
        if isinstance(kind, type) and kind is not Error and not issubclass(kind, Warning):
            assert issubclass(kind, Error) and issubclass(kind, ValueError | OSError | RuntimeError), kind
            again = pickle.loads(pickle.dumps(kind("the plug is out: put it in")))
            assert (type(again), str(again)) == (kind, "the plug is out: put it in")


def test_the_packages_export_what_they_say():
    for package in (hardware, pipeline, tikernels):
        for name in package.__all__:
            assert hasattr(package, name), f"{package.__name__}.{name}"
