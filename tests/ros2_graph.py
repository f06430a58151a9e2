"""A graph of ROS 2 in which messages arrive at once, with a clock of its own.

It stands for the middleware: real messages, and the calls of a node that this package uses.
"""

from types import SimpleNamespace

from hrc_learn.kinematics import panda

NAMES = panda.chain.joint_names
READY = panda.chain.ready.numpy()


class Graph:
    """A node's topics: what it publishes is kept, and what a test sends it takes at once.

    Attributes:
        listeners: Subscriptions that its publishers count.
        clocks: Publishers of a simulated clock.
        greeting: Joint states that come as soon as it listens.
        qualities: Quality of service of each topic that it takes or sends.
        kinds: Names of the messages that it sends, by topic.
        sleeps: Durations for which it was waited [s].
    """

    def __init__(self):
        self.takers, self.sent, self.closed = {}, [], False
        self.now, self.listeners, self.greeting = 50.0, 1, [(10.0, READY)]
        self.node, self.trips, self.parameters, self.log = self, [], {}, []
        self.clocks = 0
        self.forms, self.qualities, self.kinds, self.sleeps = {}, {}, {}, []

    def create_subscription(self, kind, topic, take, quality):
        self.takers[topic], self.qualities[topic] = take, quality
        if topic.endswith("joint_states"):
            for greeting in self.greeting:
                self.state(*greeting)

    def create_publisher(self, kind, topic, quality):
        self.qualities[topic], self.kinds[topic] = quality, kind.__name__
        return SimpleNamespace(
            topic_name=topic,
            publish=lambda message: self.sent.append((topic, message)),
            get_subscription_count=lambda: self.listeners,
        )

    def count_publishers(self, topic):
        return self.clocks if topic == "/clock" else 1

    def get_clock(self):
        message = SimpleNamespace(to_msg=lambda: stamp(self.now))
        return SimpleNamespace(now=lambda: message)

    def state(self, at, position, velocity=(), names=NAMES):
        """Send a joint state with a stamp [s]."""
        from sensor_msgs.msg import JointState

        message = JointState(name=list(names), position=list(map(float, position)))
        message.velocity = list(map(float, velocity))
        message.header.stamp = stamp(at)
        topic = next(name for name in self.takers if name.endswith("states"))
        self.takers[topic](message)

    def close(self):
        self.closed = True

    # As a lifecycle node.

    def add_managed_entity(self, stages):
        self.stages = stages

    def declare_parameter(self, name, value, form):
        self.parameters[name], self.forms[name] = SimpleNamespace(value=value), form

    def get_parameter(self, name):
        return self.parameters[name]

    def get_logger(self):
        return SimpleNamespace(error=self.log.append, warning=self.log.append)

    def trigger_configure(self):
        return self.stages.on_configure(None)

    def trigger_activate(self):
        return self.stages.on_activate(None)

    def trigger_deactivate(self):
        return self.stages.on_deactivate(None)

    # As the clock.

    def monotonic(self):
        return self.now

    def sleep(self, duration):
        self.sleeps.append(duration)
        self.now += duration

    # As the watchdog.

    def Watchdog(self, timeout, stop):
        self.trips.append(timeout)
        return SimpleNamespace(
            start=lambda: self.trips.append("start"),
            feed=lambda: self.trips.append("feed"),
            close=lambda: self.trips.append("close"),
        )


def qualities_of(graph):
    """Whether each topic is reliable and keeps its last message for those that come later.

    All keep one message alone.
    """
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    assert {quality.depth for quality in graph.qualities.values()} == {1}
    return {
        topic: (
            quality.reliability == ReliabilityPolicy.RELIABLE,
            quality.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        )
        for topic, quality in graph.qualities.items()
    }


def stamp(at):
    from builtin_interfaces.msg import Time

    seconds, nanoseconds = divmod(round(at * 1e9), 10**9)
    return Time(sec=seconds, nanosec=nanoseconds)
