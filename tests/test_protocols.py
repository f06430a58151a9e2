import numpy as np
import pytest

from hrc_learn.protocols import HumanInput


@pytest.mark.parametrize("joints", [5, 6, 7])
def test_no_request_is_no_effort_on_any_arm(joints):
    np.testing.assert_array_equal(HumanInput().effort(joints), np.zeros(joints))


def test_an_effort_for_another_number_of_joints_is_refused():
    asked = HumanInput(nullspace_input=np.ones(7))
    np.testing.assert_array_equal(asked.effort(7), np.ones(7))
    with pytest.raises(ValueError, match="7 entries, but the arm has 6 joints"):
        asked.effort(6)
