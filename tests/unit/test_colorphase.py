"""What `import colorphase` offers."""

import pytest

import colorphase
import hardware.errors
import pipeline.errors
import tikernels.errors


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


def test_the_packages_export_what_they_say():
    for package in (hardware, pipeline, tikernels):
        for name in package.__all__:
            assert hasattr(package, name), f"{package.__name__}.{name}"
