"""A test is found by the name of what it tests: folders of tests mirror the rooms, and a file begins with its module's name."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "src" / "piga"
OUTSIDE = {"docs": "the documentation is no module"}
"""Folders outside of the rule, and why."""


def subjects(room: Path) -> set[str]:
    """What a test file of a room may begin with: the room itself, or a module of it."""
    if not (room / "__init__.py").is_file():
        return set()
    return {room.name, *(path.stem for path in room.glob("*.py"))} - {"__init__"}


def is_found(test: PurePosixPath) -> bool:
    """Whether a test file, as a path below ``tests``, is named ``test_<module>`` or ``test_<module>_<subject>``."""
    name = test.stem.removeprefix("test_")
    return any(name == subject or name.startswith(f"{subject}_") for subject in subjects(PACKAGE / test.parent))


def test_every_file_is_named_by_its_module() -> None:
    files = [PurePosixPath(path.relative_to(TESTS).as_posix()) for path in TESTS.rglob("test_*.py")]
    lost = sorted(str(path) for path in files if path.parts[0] not in OUTSIDE and not is_found(path))
    assert not lost, f"no module of the same folder below src/piga has this name: {', '.join(lost)}"
