"""No adaptation: what every other estimator is measured against."""

from hrc_learn.jacobian.estimators.interface import (
    ImageJacobianEstimator,
    Measurement,
    WeightState,
)


class FixedEstimator(ImageJacobianEstimator):
    """Keeps the network's weights."""

    def initial_state(self, *batch: int) -> WeightState:
        """The network's weights."""
        return WeightState(weight=self.initial_weight(*batch))

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """The same state."""
        return state
