"""The rooms of the code: who may import whom, as docs/rooms.toml says; how they are shown."""

import ast
import importlib
import importlib.util
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
MOST_FLAT = 10  # modules beside the rooms
FACTORS_MAY_USE = {"llvmlite", "factors", "gtsam", "numba", "numpy", "scipy"}


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("architecture", ROOT / "docs/architecture.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["architecture"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


house = _load()
FLOORS = house.table()["floors"]
LEVELS = {room: level for level, floor in enumerate(FLOORS) for room in floor}
ROOMS = [room for room in LEVELS if f"gsba.{room}" in house.modules()]
FOLDERS = [room for room in ROOMS if house.modules()[f"gsba.{room}"].name == "__init__.py"]


def test_every_module_is_in_a_room() -> None:
    assert set(house.ties()) == set(LEVELS)
    assert sum(map(len, FLOORS)) == len(LEVELS)
    assert len(ROOMS) - len(FOLDERS) <= MOST_FLAT


def test_rooms_import_from_floors_below() -> None:
    ties = house.ties()
    wrong = [
        f"{room} imports {other}, which stands beside or above it"
        for room, level in LEVELS.items()
        for other in ties[room]
        if LEVELS[other] >= level
    ]
    assert not wrong, wrong


def test_no_modules_import_each_other() -> None:
    ours = {
        module: house.imports(path) & house.modules().keys() - {module}
        for module, path in house.modules().items()
        if path.name != "__init__.py"  # a door names what is behind it
    }
    try:
        TopologicalSorter(ours).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' -> '.join(error.args[1])}")


def test_factors_stand_alone() -> None:
    for module, path in house.modules().items():
        if house.room_of(module) == "factors":
            used = {name.partition(".")[0] for name in house.imports(path)}
            foreign = used - FACTORS_MAY_USE - sys.stdlib_module_names
            assert not foreign, f"{module} imports {foreign}"


def test_a_room_says_what_it_takes_and_gives() -> None:
    wrong = []
    for room in [room for room in FOLDERS if room != "cli"]:
        door = importlib.import_module(f"gsba.{room}")
        lines = (door.__doc__ or "").strip().splitlines()
        said = lines[1:2] == [""] and lines[2].startswith("Takes ")
        said &= any(line.startswith("Gives ") for line in lines[3:])
        there = all(getattr(door, name, None) is not None for name in door.__all__)
        if not (said and door.__all__ and there):
            wrong.append(room)
    assert FOLDERS and not wrong, wrong


def test_no_stage_sets_what_another_reads() -> None:
    """In the pipeline no attribute is set but by `__init__`."""
    for module, path in house.modules().items():
        if house.room_of(module) == "pipeline":
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                stored = isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
                assert not stored, f"{module}:{node.lineno} sets an attribute"


def test_stations_exist() -> None:
    for way in house.table()["ways"]:
        for station, _ in way["stations"]:
            name = station.partition(":")[2]
            assert hasattr(importlib.import_module(house._module(station)), name), station


def test_the_page_shows_the_code_as_it_is() -> None:
    """Renew it with `python docs/architecture.py`."""
    assert house.PICTURE.read_text(encoding="utf-8") == house.svg()
    text = house.PAGE.read_text(encoding="utf-8")
    assert house.page(text) == text
