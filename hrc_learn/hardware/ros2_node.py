"""Run the adaptive controller with its safety filter as a lifecycle node of ROS 2."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hrc_learn.controller import (
    INITIAL_IMAGE_JACOBIAN,
    INTERVENTIONS,
    AdaptiveController,
    ControllerConfig,
    Goals,
    Observation,
    SafetyConfig,
)
from hrc_learn.demos.recording_messages import image_of
from hrc_learn.deploy import EagerRunner, StepRunner
from hrc_learn.hardware.driver_process import ArmFaultError
from hrc_learn.hardware.ros2_arm import Ros2Arm, Ros2Config
from hrc_learn.hardware.ros2_topics import Ros2Session, quality, stamp_of
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import SerialChain
from hrc_learn.store import read_toml

PARAMETERS: dict[str, list] = read_toml(Path(__file__).with_name("ros2_parameters.toml"))
"""Parameters of the node, read at `configure`: default, range and meaning."""
_REPORTS = 0.1
"""Period of the markers [s]. The period of the diagnostics is ten times as long."""
_RECENT = 500
"""Number of newest commands whose latency the diagnostics report."""
_HISTORY = 500
"""Number of joint states kept, to find the one at the time of an image."""
_PUSH = 0.25
"""Time after which a push ends without a new message [s], because the message that ends it may
be lost. Pushes from the browser page end after the same time."""
_PATH = 200
"""Number of points of the tool path in the markers, 20 s at their period."""


class ControllerNode:
    """A node that keeps the tool in a goal region, and its feature at a target in the image.

    `configure` builds the controller, `activate` holds the tool where it is and then follows
    goals, and `deactivate` brings the arm to rest. Old joint states, a missing heartbeat and
    faults of the arm deactivate the node.

    Attributes:
        session: The node.
        stopped: Reason of the last stop; empty while active.
        commands: Number of commands so far.
        latencies: Time from the arrival of a joint state to its command [s], for each of the
            newest 100,000 commands.
    """

    def __init__(
        self,
        chain: SerialChain,
        config: Ros2Config | None = None,
        safety: SafetyConfig | None = None,
        make_runner: Callable[[AdaptiveController, Observation], StepRunner] = EagerRunner,
    ):
        """Create the node, unconfigured.

        Args:
            chain: Kinematics of the arm.
            config: Topics of the arm.
            safety: Settings of the safety filter; the parameter `tcp_speed` replaces its cap on
                the tool's speed.
            make_runner: Creates the runner of the controller's step, compiled or not.
        """
        from rclpy.lifecycle import LifecycleNode, ManagedEntity, TransitionCallbackReturn

        self._chain, self._config, self._make = chain, config or Ros2Config(), make_runner
        self._safety, self._done = safety or SafetyConfig(), TransitionCallbackReturn
        self.session = Ros2Session("hrc_learn", LifecycleNode)
        self.node: Any = self.session.node
        self.latencies, self.commands = deque[float](maxlen=100_000), 0
        # Held during a control step, and while a feature is stored.
        self._seeing = threading.Lock()
        self._arm: Ros2Arm | None = None
        self._runner: StepRunner
        self._inactive, self.stopped = threading.Event(), ""
        self._inactive.set()
        self._thread: threading.Thread | None = None
        self._heard = self._shown = self._diagnosed = self._pushed = self._last = 0.0
        self._taken = 0.0  # time of the joint state at the newest feature's exposure [s]
        self._states = deque[tuple[float, np.ndarray]](maxlen=_HISTORY)
        self._path = deque[Any](maxlen=_PATH)  # messages: creating them costs 5 us each
        stages = ManagedEntity()
        for stage in ("configure", "activate", "deactivate", "cleanup", "shutdown"):
            setattr(stages, f"on_{stage}", self._transition(getattr(self, stage)))
        self.node.add_managed_entity(stages)
        self._declare()
        self._connect()

    def _transition(self, act: Callable[[], None]) -> Callable[[Any], Any]:
        def carry_out(_state: Any) -> Any:
            try:
                act()
            except (ArmFaultError, ConnectionError, ValueError) as error:
                self.node.get_logger().error(str(error))
                return self._done.FAILURE
            return self._done.SUCCESS

        return carry_out

    def _declare(self) -> None:
        from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor

        for name, (value, low, high, text) in PARAMETERS.items():
            bounds = [FloatingPointRange(from_value=low, to_value=high)]
            form = ParameterDescriptor(description=text, floating_point_range=bounds)
            self.node.declare_parameter(name, value, form)

    def _value(self, name: str) -> float:
        return self.node.get_parameter(name).value

    def _connect(self) -> None:
        """Subscribe to the topics of goals, images, pushes and heartbeats, and create the
        publishers for monitoring.
        """
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PointStamped, PoseStamped
        from sensor_msgs.msg import CompressedImage, Image
        from std_msgs.msg import Empty, Float64MultiArray
        from visualization_msgs.msg import Marker, MarkerArray

        once = quality(reliable=True)
        for kind, topic, take, form in (
            (PoseStamped, "~/goal", self._on_goal, once),
            (Marker, "~/region", self._on_region, once),
            (PointStamped, "~/target", self._on_target, once),
            (PointStamped, "~/feature", self._on_feature, quality()),
            (Image, "~/image", self._on_image, quality()),
            (CompressedImage, "~/image/compressed", self._on_image, quality()),
            (Float64MultiArray, "~/push", self._on_push, quality()),
            (Empty, "~/heartbeat", self._on_heartbeat, quality()),
        ):
            self.node.create_subscription(kind, topic, self._checked(take), form)
        self._diagnostics = self.node.create_publisher(DiagnosticArray, "/diagnostics", once)
        self._markers = self.node.create_publisher(MarkerArray, "~/markers", once)

    def configure(self) -> None:
        """Read the parameters, build the controller and wait for the arm."""
        speed = self._value("tcp_speed")
        config = ControllerConfig(
            linear_speed=self._value("linear_speed"),
            angular_speed=self._value("angular_speed"),
            null_damping=self._value("null_damping"),
            safety=replace(self._safety, tcp_speed=speed),
        )
        q = self._chain.ready
        J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
        estimator = KalmanEstimator(RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1))
        pose = self._chain.forward(q)
        pixel = q.new_zeros(2) + 100.0
        goals = Goals.at(pose.position, pose.orientation, pixel).with_vision(False)
        controller = AdaptiveController(self._chain, estimator, goals, config=config)
        observation = replace(
            Observation.unseen(q, pixel, 0.002), feature_age=q.new_zeros(()), goals=goals
        )
        self._runner, self._detector = self._make(controller, observation), None
        if (marker := round(self._value("marker"))) >= 0:
            from hrc_learn.vision import MarkerDetector

            self._detector = MarkerDetector([marker])
        self._runner.step()  # the first step is slower than all others
        self._arm = arm = Ros2Arm(self._chain, self._config)
        arm.answer = partial(self._answer, arm)

    def activate(self) -> None:
        """Hold the tool where it is, and follow goals from now on.

        Raises:
            ArmFaultError: The joint states are too old.
        """
        assert self._arm is not None
        self._arm.recover()
        state, values = self._arm.read(), self._runner.observation
        pose = self._chain.forward(state.joint_position)
        values["goals.position.centre"][:] = pose.position.numpy()
        values["goals.position.half_size"][:] = self._value("region_size")
        values["goals.orientation.goal"][:] = pose.orientation.numpy()
        values["goals.vision_enabled"][...] = values["feature_visible"][...] = 0
        values["nullspace_input"][:] = 0
        self._runner.start(state.joint_position, state.joint_velocity)
        self._heard, self._last, self.stopped = time.monotonic(), 0.0, ""
        self._inactive.clear()
        self._thread = threading.Thread(target=self._watch, args=[self._arm], daemon=True)
        self._thread.start()

    def deactivate(self) -> None:
        """Bring the arm to rest."""
        self._inactive.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)
        with self._seeing:  # a step may be under way
            pass
        if self._arm is not None:
            self._arm.stop()

    def cleanup(self) -> None:
        """Bring the arm to rest and disconnect."""
        self.deactivate()
        if self._arm is not None:
            self._arm.close()
            self._arm = None

    shutdown = cleanup

    def _watch(self, arm: Ros2Arm) -> None:
        """Until deactivated, stop the arm as soon as joint states or heartbeats stay away."""
        while not self._inactive.wait(self._config.silence / 4):
            with self._stopping_faults():
                arm.read()
                self._check_heartbeat()

    @contextmanager
    def _stopping_faults(self) -> Iterator[None]:
        """Bring the arm to rest and deactivate the node if the block raises an error."""
        try:
            yield
        except Exception as error:  # whatever its kind, the arm must stop
            if self._inactive.is_set():
                return
            self.stopped = str(error)
            self.node.get_logger().error(f"deactivated: {error}")
            self.deactivate()
            self._report(time.monotonic())
            self.node.trigger_deactivate()

    def _check_heartbeat(self) -> None:
        limit, silent = self._value("heartbeat"), time.monotonic() - self._heard
        if limit and silent > limit:
            raise ArmFaultError(f"no heartbeat for {silent:.2f} s: send ~/heartbeat")

    def _answer(self, arm: Ros2Arm) -> None:
        """Answer a joint state with a command, in the thread that has received it."""
        with self._stopping_faults(), self._seeing, torch.inference_mode():
            if self._inactive.is_set():
                return
            self._check_heartbeat()
            state, values, now = arm.read(), self._runner.observation, time.monotonic()
            if self._last:
                step = max(state.time - self._last, 1e-3)
                values["dt"][...] = min(step, self._config.silence)
            self._last = state.time
            values["joint_position"][:] = state.joint_position
            if now - self._pushed > _PUSH:
                values["nullspace_input"][:] = 0
            values["feature_age"][...] = state.time - self._taken
            command = self._runner.step()
            values["feature_new"][...] = 0
            self._states.append((state.time, state.joint_position))
            arm.command(command)
            self.commands += 1
            self.latencies.append(time.monotonic() - arm.received)
            self._report(now)

    def _checked(self, take: Callable[[Any], None]) -> Callable[[Any], None]:
        """Wrap a callback so that its errors are logged; otherwise, they would end the
        thread.
        """

        def guarded(message: Any) -> None:
            try:
                if not hasattr(self, "_runner"):
                    raise ValueError("a message is refused: configure the node first")
                take(message)
            except Exception as error:
                self.node.get_logger().warning(str(error))

        return guarded

    def _pose(self, message: Any, what: str) -> tuple[np.ndarray, np.ndarray]:
        """Position [m] and unit quaternion of a message, in the base frame."""
        frame, base = message.header.frame_id, self._config.base
        if base and frame not in ("", base):
            raise ValueError(f"a {what} in frame {frame} is refused: give it in {base}")
        at, turn = message.pose.position, message.pose.orientation
        pose = np.array([at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z])
        if not np.isfinite(pose).all() or not pose[3:].any():
            raise ValueError(f"a {what} with NaN or without orientation is refused")
        return pose[:3], pose[3:] / np.linalg.norm(pose[3:])

    def _on_goal(self, message: Any) -> None:
        position, orientation = self._pose(message, "goal")
        self._runner.observation["goals.position.centre"][:] = position
        self._runner.observation["goals.orientation.goal"][:] = orientation

    def _on_region(self, message: Any) -> None:
        centre, orientation = self._pose(message, "region")
        size = 0.5 * np.array([message.scale.x, message.scale.y, message.scale.z])
        if not (size > 0).all() or abs(orientation[0]) < 1 - 1e-6:
            text = "a region is refused: give edges longer than 0, parallel to the base's axes"
            raise ValueError(text)
        self._runner.observation["goals.position.centre"][:] = centre
        self._runner.observation["goals.position.half_size"][:] = size

    def _on_target(self, message: Any) -> None:
        values, pixel = self._runner.observation, (message.point.x, message.point.y)
        values["goals.vision.target"][:] = pixel
        values["goals.vision_enabled"][...] = np.isfinite(pixel).all()

    def _on_feature(self, message: Any) -> None:
        self._see(np.array([message.point.x, message.point.y]), stamp_of(message))

    def _on_image(self, message: Any) -> None:
        if self._detector is not None:
            found = self._detector.detect(image_of(message))
            pixel = next(iter(found.values())).mean(0) if found else np.full(2, np.nan)
            self._see(pixel, stamp_of(message))

    def _see(self, pixel: np.ndarray, stamp: float) -> None:
        """Pair a feature with the joint positions at the time of its image."""
        values = self._runner.observation
        with self._seeing:
            visible = len(self._states) > 0 and np.isfinite(pixel).all()
            values["feature_visible"][...] = values["feature_new"][...] = visible
            if visible:
                wanted = stamp or self._states[-1][0]
                self._taken, q = min(self._states, key=lambda one: abs(one[0] - wanted))
                values["feature"][:], values["image_joint_position"][:] = pixel, q

    def _on_push(self, message: Any) -> None:
        effort, values = np.array(message.data), self._runner.observation["nullspace_input"]
        if effort.shape != values.shape or not np.isfinite(effort).all():
            raise ValueError(f"a push is refused: give {len(values)} finite numbers")
        values[:], self._pushed = effort, time.monotonic()

    def _on_heartbeat(self, _message: Any) -> None:
        self._heard = time.monotonic()

    def _report(self, now: float) -> None:
        """Publish diagnostics and markers, both at low rates."""
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
        from geometry_msgs.msg import Point
        from visualization_msgs.msg import MarkerArray

        stamp = self.node.get_clock().now().to_msg()
        if self.stopped or now - self._diagnosed > 10 * _REPORTS:
            self._diagnosed, rows = now, self.figures(_RECENT)
            rows["ignored_states"] = 0 if self._arm is None else self._arm.ignored
            status = DiagnosticStatus(
                level=DiagnosticStatus.ERROR if self.stopped else DiagnosticStatus.OK,
                name="hrc_learn: controller",
                message=self.stopped or "active",
                values=[KeyValue(key=k, value=f"{v:g}") for k, v in rows.items()],
            )
            message = DiagnosticArray(status=[status])
            message.header.stamp = stamp
            self._diagnostics.publish(message)
        if now - self._shown > _REPORTS:
            self._shown = now
            q = self._runner.observation["joint_position"]
            x, y, z = self._chain.forward(q.copy()).position.tolist()
            self._path.append(Point(x=x, y=y, z=z))
            self._markers.publish(MarkerArray(markers=self._drawn(stamp)))

    def _drawn(self, stamp: Any) -> list[Any]:
        """Markers for the box of the goal and the path of the tool."""
        from visualization_msgs.msg import Marker

        values = self._runner.observation
        box, path = Marker(type=Marker.CUBE), Marker(type=Marker.LINE_STRIP, id=1)
        centre, size = values["goals.position.centre"], 2 * values["goals.position.half_size"]
        for axis, at, edge in zip("xyz", centre.tolist(), size.tolist(), strict=True):
            setattr(box.pose.position, axis, at)
            setattr(box.scale, axis, edge)
        path.scale.x = 0.004
        path.points = list(self._path)
        for marker, colour in ((box, (0.2, 0.6, 1.0, 0.3)), (path, (1.0, 0.6, 0.1, 1.0))):
            marker.header.frame_id, marker.header.stamp = self._config.base, stamp
            marker.ns = "hrc_learn"
            marker.color.r, marker.color.g, marker.color.b, marker.color.a = colour
        return [box, path]

    def start(self) -> bool:
        """Configure and activate; False if that failed, as explained in the log."""
        done = self._done.SUCCESS
        return self.node.trigger_configure() == done and self.node.trigger_activate() == done

    def figures(self, recent: int = 0) -> dict[str, float]:
        """Number of commands; number of steps in which the safety filter intervened, by limit;
        and percentiles of the latency from joint state to command [ms].

        Args:
            recent: Number of newest commands whose latency counts; 0: all.
        """
        rows = {"commands": float(self.commands)}
        if hasattr(self, "_runner"):
            counts = map(float, self._runner.state["safety.counts"])
            rows |= {f"safety_{k}": n for k, n in zip(INTERVENTIONS, counts, strict=True)}
        values = 1e3 * np.array([*self.latencies][-recent:] or [np.nan])
        for percentile in (50, 99, 100):
            rows[f"latency_p{percentile}_ms"] = float(np.percentile(values, percentile))
        return rows

    def close(self) -> None:
        """Bring the arm to rest and leave the graph."""
        self.cleanup()
        self.session.close()
