"""The licences of the packages that pip installs with this one."""

from email.message import Message
from types import SimpleNamespace

import pytest

import list_licences


def test_every_dependency_is_compatible_with_apache_2():
    found = list_licences.installed()
    assert {"numpy", "torch", "scipy", "matplotlib", "kiwisolver", "pycolmap"} <= set(found)
    assert list_licences.incompatible() == []


def test_the_document_is_generated():
    assert list_licences.DOCUMENT.read_text(encoding="utf-8") == list_licences.document()


def test_every_exception_is_explained_and_used():
    assert set(list_licences.NOTES) <= set(list_licences.installed())
    assert set(list_licences.NOTES) >= list_licences.EXCEPTIONS


@pytest.mark.parametrize(
    ("expression", "allowed"),
    [
        ("MIT", True),
        ("GPL-3.0-only", False),
        ("GPL-2.0-only OR MIT", True),
        ("MIT AND AGPL-3.0-only", False),
        ("MIT AND (GPL-3.0-only OR BSD-3-Clause)", True),
        ("MIT AND (GPL-3.0-only AND BSD-3-Clause)", False),
        ("GPL-3.0-or-later WITH GCC-exception-3.1 AND MIT", True),
        ("unknown", False),
    ],
)
def test_licence_expressions_are_evaluated(expression, allowed):
    assert list_licences.compatible(expression) is allowed


@pytest.mark.parametrize(
    ("fields", "meant"),
    [
        ({"License-Expression": "MIT OR Apache-2.0"}, "MIT OR Apache-2.0"),
        ({"License": "BSD 3-Clause"}, "BSD-3-Clause"),
        ({"License": "GPLv3"}, "GPLv3"),
        ({"Classifier": "License :: OSI Approved :: MIT License"}, "MIT"),
        ({"License": "a text\nof many lines", "Classifier": "License :: OSI Approved :: MIT License"}, "MIT"),
        ({"Classifier": "Topic :: Games"}, "unknown"),
    ],
)
def test_a_licence_is_read_from_the_metadata(fields, meant):
    metadata = Message()
    for name, value in fields.items():
        metadata[name] = value
    assert list_licences.licence(SimpleNamespace(metadata=metadata)) == meant
