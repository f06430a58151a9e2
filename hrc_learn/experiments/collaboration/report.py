"""The report of a collaboration: sections with their figures."""

from hrc_learn.experiments.collaboration.figures import (
    Spans,
    end_effector_figure,
    marker_figure,
    timeline_figure,
    trajectories_figure,
)
from hrc_learn.experiments.collaboration.trial import CollaborationRun
from hrc_learn.viz import RunRecording
from hrc_learn.viz.figures import image_jacobian_figure, joints_figure, person_figure
from hrc_learn.viz.report import Picture, Section

SUMMARY = (
    "An arm grasps objects with an uncalibrated camera while a person pushes its elbow aside "
    "to reach under it. It then carries each object to a cabinet along a motion learned from "
    "demonstrations of end effector and null-space posture at once, and places it on a shelf. "
    "Simulated in MuJoCo; success is read from contacts there."
)


def collaboration_sections(run: CollaborationRun, recording: RunRecording) -> list[Section]:
    """Timeline, grasping, person, placing."""
    objects: Spans = {pick.item.name: pick.span for pick in run.picks}
    notes = [
        f"{note.time:.1f} s, {pick.item.name}: {note.mishap}: {note.what}."
        for pick in run.picks
        for note in pick.recoveries
    ]
    return [
        Section(
            heading="The job",
            text=(
                "A state machine: detect, servo, wait for the person, grasp, carry home, "
                f"transfer, release, retreat. {' '.join(notes) or 'No recovery was needed.'}"
            ),
            figures=(
                Picture("timeline", timeline_figure(recording, objects), "Phases over time."),
            ),
        ),
        Section(
            heading="Grasping with an uncalibrated camera",
            text=(
                "The gripper's marker is brought to where demonstrations had it above the "
                "object. The image Jacobian was learned from them and adapts online, also to a "
                "camera that was moved."
            ),
            figures=(
                Picture(
                    "marker",
                    marker_figure(recording, objects),
                    "Paths of the marker over the camera's first image, and its distance from "
                    "the target.",
                ),
                Picture(
                    "image_jacobian",
                    image_jacobian_figure(recording),
                    "Image Jacobian: the controller's estimate and the simulator's truth.",
                ),
            ),
        ),
        Section(
            heading="The person",
            text=(
                "The person's force acts in the null space of the end effector's task: the "
                "elbow yields, the end effector stays."
            ),
            figures=(
                Picture(
                    "end_effector",
                    end_effector_figure(recording),
                    "Position and orientation of the end effector, and the person's effort.",
                ),
                Picture(
                    "person",
                    person_figure(recording),
                    "Effort, elbow and end effector, enlarged.",
                ),
            ),
        ),
        Section(
            heading="Carrying and placing",
            text="The demonstration, and the arm's motion with every object.",
            figures=(
                Picture(
                    "trajectories",
                    trajectories_figure(recording, objects),
                    "Paths of the end effector.",
                ),
                Picture("joints", joints_figure(recording), "Joint positions and limits."),
            ),
        ),
    ]
