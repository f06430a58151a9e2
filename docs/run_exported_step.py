"""Run a control step of `export_torch_package.py` without the library that made it.

    python docs/run_exported_step.py step.pt2

The arm moves as it is told; a real loop would read its joints and write to its driver.
"""

import math
import statistics
import sys
import time

import torch
import torch._inductor

DT = 0.002  # the step the package was exported with [s]

step = torch._inductor.aoti_load_package(sys.argv[1])
says = step.get_metadata()

# Where each field stands in the three vectors of numbers.
rows, sizes = {}, {"state": 0, "observation": 0, "command": 0}
for line in says["hrc_learn.layout"].splitlines():
    vector, name, _dtype, _batched, *shape = line.split()
    first = sizes[vector]
    sizes[vector] += math.prod(map(int, shape))
    rows[vector, name] = slice(first, sizes[vector])

# An arm at rest, the observation of the export, and room for the command.
state, observation = (
    torch.tensor([float(x) for x in says[f"hrc_learn.{vector}"].split()], dtype=torch.float64)
    for vector in ("state", "observation")
)
command = torch.zeros(sizes["command"], dtype=torch.float64)
q = observation[rows["observation", "joint_position"]].numpy()
velocity = command[rows["command", "joint_velocity"]].numpy()

seconds = []
for _ in range(1000):
    began = time.perf_counter()
    step(state, observation, command)  # writes the command and the next state
    seconds.append(time.perf_counter() - began)
    q += DT * velocity

print("joints at", *(f"{angle:.9f}" for angle in q))
print(f"median step {1e6 * statistics.median(seconds):.0f} us")
