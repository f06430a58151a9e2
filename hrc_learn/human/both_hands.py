"""Several sources of a person's input at once, as the paper's mixed interface has two."""

from ..protocols import ArmState, Human, HumanInput


class BothHands:
    """One hand leads the end effector by a device, the other the body in the browser.

    Efforts and motions add up. Of what is asked for otherwise, the first source that says
    anything is heard; requests of all are.
    """

    def __init__(self, *sources: Human):
        """Join them.

        Raises:
            ValueError: There are none.
        """
        if not sources:
            raise ValueError("a person needs at least one source of input.")
        self._sources = sources

    def read(self, state: ArmState) -> HumanInput:
        """What all sources ask for together."""
        inputs = [source.read(state) for source in self._sources]
        first, *others = inputs
        return HumanInput(
            effort=sum((other.effort for other in others), first.effort),
            twist=sum((other.twist for other in others), first.twist),
            gripper=next((i.gripper for i in inputs if i.gripper is not None), None),
            region=next((i.region for i in inputs if i.region is not None), None),
            target=next((i.target for i in inputs if i.target is not None), None),
            requests=tuple(request for i in inputs for request in i.requests),
        )
