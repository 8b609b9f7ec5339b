"""Aravis by its C library: what is said where it is missing or too old, and what becomes of its errors."""

import ctypes

import pytest

from hardware.camera import aravis_library
from hardware.camera.aravis_library import load_aravis
from hardware.errors import CameraError


@pytest.fixture
def asked_anew():
    load_aravis.cache_clear()
    yield
    load_aravis.cache_clear()


@pytest.mark.usefixtures("asked_anew")
def test_where_it_is_missing_the_package_is_named(monkeypatch):
    monkeypatch.setattr(aravis_library, "_NAME", "libnonesuch-0.8.so.0")
    with pytest.raises(CameraError, match=r"need Aravis: .*(libaravis-0\.8|brew install aravis|take the maker's)"):
        load_aravis()


@pytest.mark.usefixtures("asked_anew")
def test_a_library_without_its_functions_is_too_old(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    with pytest.raises(CameraError, match=r"too old, 0\.8\.23 or later is needed: .*arv_"):
        load_aravis()


@pytest.mark.usefixtures("aravis")
def test_an_error_of_the_library_is_one_of_ours():
    with pytest.raises(CameraError, match="not found"):
        load_aravis().arv_open_device(b"no such camera")
    with pytest.raises(AttributeError, match="arv_no_such_function"):
        load_aravis().arv_no_such_function  # noqa: B018
