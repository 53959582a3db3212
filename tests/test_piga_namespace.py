"""The flat namespace: light to import, complete, and every public name of a room can be had."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

import piga


def test_about_forty_names_and_all_of_them_are_there():
    assert 40 <= len(piga.__all__) <= 50
    for name in piga.__all__:
        assert getattr(piga, name) is not None
        assert name in dir(piga)


def test_importing_piga_loads_no_numpy_and_rooms_come_by_themselves():
    code = (
        "import sys, piga; assert 'numpy' not in sys.modules; assert 'piga.platform' not in sys.modules\n"
        "assert piga.platform.compare.__module__ == 'piga.platform.chain'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("room", piga.ROOMS)
def test_every_public_name_of_a_room_is_there_and_says_what_it_is(room):
    module = getattr(piga, room)
    assert module is importlib.import_module(f"piga.{room}")
    for name in module.__all__:
        value = getattr(module, name)
        if isinstance(value, type) or type(value).__name__ == "function":
            assert value.__doc__, f"{room}.{name}"
    with pytest.raises(AttributeError, match="nothing"):
        _ = module.nothing
