"""Run an exported control step without the library that made it.

    python docs/run_exported_step.py step-....pt2

The arm moves as it is told; a real loop would read its joints and write to its driver.
"""

import io
import statistics
import sys
import time
import zipfile

import numpy as np
import torch

DT = 0.002  # the step the package was exported with [s]

package = sys.argv[1]
with zipfile.ZipFile(package) as archive:
    kept = np.load(io.BytesIO(archive.read("extra/hrc_learn.npz")))
# Inputs in their order: the state, then the observation. Outputs: the command, then the state.
state = [torch.from_numpy(kept[name]) for name in kept.files if name.startswith("state.")]
names = [name for name in kept.files if name.startswith("observation.")]
observation = [torch.from_numpy(kept[name]) for name in names]
arrays = {name: x.numpy() for name, x in zip(names, observation, strict=True)}
commands = [name for name in kept.files if name.startswith("command.")]
velocity_at = commands.index("command.joint_velocity")

# torch.export's public `torch._inductor.aoti_load_package` takes the same file, but seconds.
loader = torch._C._aoti.AOTIModelPackageLoader(package, "model", False, 1, -1)

seconds = []
for _ in range(1000):
    began = time.perf_counter()
    outputs = loader.run(state + observation)
    velocity = outputs[velocity_at].numpy()
    state = outputs[len(commands) :]
    seconds.append(time.perf_counter() - began)
    arrays["observation.joint_position"] += DT * velocity

print("joints at", *(f"{q:.9f}" for q in arrays["observation.joint_position"]))
print(f"median step {1e6 * statistics.median(seconds):.0f} us")
