import dataclasses
import pickle

import pytest

from sfm.core import events
from sfm.core.events import SILENT, Event, Note, Observer, StageStarted

KINDS = [kind for kind in vars(events).values() if isinstance(kind, type) and issubclass(kind, Event)]
SAMPLES = {"str": "x", "int": 3, "float": 0.5}


def sample(kind):
    return kind(**{field.name: SAMPLES[field.type] for field in dataclasses.fields(kind)})


@pytest.mark.parametrize("kind", KINDS)
def test_events_are_values_of_plain_fields(kind):
    """Plain fields are what a line of the JSON log can hold, and what another process can send."""
    event = sample(kind)
    assert event == sample(kind)
    assert pickle.loads(pickle.dumps(event)) == event
    assert set(dataclasses.asdict(event)) == {field.name for field in dataclasses.fields(kind)}
    assert kind.__doc__


@pytest.mark.parametrize("kind", KINDS)
def test_events_cannot_be_changed_nor_built_by_position(kind):
    fields = dataclasses.fields(kind)
    if fields:
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(sample(kind), fields[0].name, None)
        with pytest.raises(TypeError):
            kind("by position")


def test_the_silent_observer_takes_any_event_and_says_nothing(capsys):
    observer: Observer = SILENT
    assert observer(Note(message="kernels compile")) is None
    assert capsys.readouterr() == ("", "")


def test_a_list_observes(rng):
    seen: list[Event] = []
    observer: Observer = seen.append
    observer(StageStarted(stage="features", total=3))
    assert seen == [StageStarted(stage="features", total=3, cached=0)]
