"""The flat namespace: light to import, complete, and every public name of a room can be had."""

from __future__ import annotations

import importlib
import subprocess
import sys

import numpy as np
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


def test_closed_form_takes_a_force_as_propagate_does():
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=0.7)
    wanted = piga.closed_form(inst, 10.0, 9.8, 49.0, 1.0)
    assert piga.closed_form(inst, 10.0, [9.8, 49.0, 1.0]) == wanted
    assert piga.closed_form(inst, 10.0, f=np.array([9.8, 49.0, 1.0])) == wanted
    assert piga.closed_form(inst, 10.0, a_x=9.8, a_Y=49.0, a_Z=1.0) == wanted
    t = np.linspace(0.0, 10.0, 21)
    along = piga.propagate(inst, t, np.tile([9.8, 49.0, 1.0], (21, 1)), between="linear")
    assert along[-1] == pytest.approx(float(wanted[0]), abs=1e-12)
    for wrong in ({"f": [1.0, 2.0]}, {"f": 9.8}, {}, {"a_x": 1.0}, {"f": [1.0, 2.0, 3.0], "a_Y": 1.0}):
        with pytest.raises(piga.ArgumentError, match="f: "):
            piga.closed_form(inst, 10.0, **wrong)
