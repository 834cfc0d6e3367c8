"""A stage that reads a setting has it in its key, or rests on one that has: none is resumed under
settings it was not computed with."""

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from tiny_run import LIGHT, Case

from gsba import refine
from gsba.config_file import load_config
from gsba.store import store
from gsba.store.store import RunStore

CHANGES = (*LIGHT, "seed=7919", "weak_frames.mode=auto", "export.formats=[]")
# Results do not depend on threads. Keys have the readout and the stitching radius of a camera
# instead of its name, and directions of its lenses where they are given.
NOT_IN_KEYS = {"num_threads", "name", "baseline_mm", "readout_ms", "lens_yaws_deg"}
UNNAMED = {"seed", "extractor", "matcher", "gate_factor"}  # whose values alone are in keys


@pytest.mark.parametrize("with_trajectory", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_keys_of_stages_hold_the_settings_that_these_read(
    case: Case, with_trajectory: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, computing = dict[str, str](), list[str]()
    read = defaultdict[str, set[tuple[str, str]]](set)
    key, measuring, get = RunStore._key, store._measuring, BaseModel.__getattribute__

    def keyed(self: RunStore, name: str, settings: object, after: Sequence[str]) -> str:
        own = json.dumps(settings, default=store._jsonable)
        keys[self._prefix + name] = own + "".join(keys[self._prefix + stage] for stage in after)
        return key(self, name, settings, after)

    def measured(name: str, *given: Any) -> Callable[[], store.StageRecord]:
        computing.append(name)
        record = measuring(name, *given)
        return lambda: (computing.remove(name), record())[1]

    def got(self: BaseModel, name: str) -> object:
        value = get(self, name)
        if computing and name in type(self).model_fields and not isinstance(value, BaseModel):
            read[computing[-1]].add((name, json.dumps(value)))
        return value

    monkeypatch.setattr(RunStore, "_key", keyed)
    monkeypatch.setattr(store, "_measuring", measured)
    monkeypatch.setattr(BaseModel, "__getattribute__", got)
    trajectory = case.slam if with_trajectory else None
    refine(case.frames, trajectory, tmp_path / "run", load_config(None, CHANGES))
    monkeypatch.undo()

    missing = {
        (stage, name)
        for stage, found in read.items()
        for name, value in found
        if name not in NOT_IN_KEYS
        and (value if name in UNNAMED else f'"{name}": ') not in keys[stage]
    }
    assert not missing and sum(map(len, read.values())) > 30
