"""The phases of a training run, one module each: changes of the model, once or a few times in a run, between steps."""

from collections.abc import Mapping
from typing import Any

from pd4dgs_codec.train.state import TrainState

#: Shorter runs have no phase that measures pictures: their models have not converged far enough half way.
MIN_ITERATIONS = 500


class Phase:
    """A phase of a run. Learner asks each in turn before a step whether it is due; growing, after the update."""

    def due(self, state: TrainState) -> bool:
        """Whether the phase acts at this step of the schedule."""
        raise NotImplementedError

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Changes the model and adds to the step's log record. Raises NotFinite if the model has diverged."""
        raise NotImplementedError

    def stored(self) -> dict[str, Any]:
        """The phase's state for a checkpoint, so that a resumed run continues alike."""
        return {}

    def restore(self, stored: Mapping[str, Any]) -> None:
        """The inverse of `stored`."""


def long_enough(state: TrainState) -> bool:
    """Whether the run is long enough for phases that measure pictures, or continues one that was."""
    return state.model.frozen > 0 or (state.schedule.iterations or 0) >= MIN_ITERATIONS
