"""The flat namespace: light to import, complete, and every public name of a room can be had; files are read from their text."""

from __future__ import annotations

import importlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

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


EXAMPLES = Path(__file__).parents[1] / "examples"


def test_a_file_is_read_from_its_text():
    for read, file in ((piga.read_plan, "plan-dividing-head.toml"), (piga.read_scenario, "twin.toml")):
        path = EXAMPLES / file
        assert read(file, content=path.read_text(encoding="utf-8")).table == read(path).table
        with pytest.raises(piga.RunFileError, match=r"nothing\.toml: not valid TOML"):
            read("nothing.toml", content="[")
    path = EXAMPLES / "platform-piga.toml"
    scenario = piga.platform.load_scenario("p.toml", content=path.read_text(encoding="utf-8"))
    assert replace(scenario, source=None) == replace(piga.platform.load_scenario(path), source=None)
    text = (EXAMPLES / "certificate.toml").read_text(encoding="utf-8")
    assert piga.certificate.read_certificate_file("c.toml", content=text).item.description
