"""Compile MuJoCo Warp's kernels of a twin for a GPU (sm_90) without one:

    python .ci/gpu/warp_kernels.py OUT [TASK [arch [SETTINGS]]]

A step is taken with launches that are only noted, and with a device that says it is a GPU; each module is then compiled into
OUT/<version of Warp>, which WARP_CACHE_PATH=OUT names on the GPU machine: 82 kernels in 5 minutes on two busy cores. What is
there, of another task, is kept.
"""

import sys
from pathlib import Path

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.config.kernel_cache_dir = sys.argv[1]  # to which Warp adds its version
wp.init()
noted: dict[tuple[int, int], tuple[wp.Module, int]] = {}
noting = False


def noting_instead_of(launch):  # before mujoco_warp imports it
    def noted_launch(kernel, *arguments, **named):
        if noting:
            block_dim = named.get("block_dim") or kernel.module.options.get(
                "block_dim", 256
            )
            noted[id(kernel.module), block_dim] = kernel.module, block_dim
            return None
        return launch(kernel, *arguments, **named)

    return noted_launch


class Gpu:
    is_cuda, is_cpu = True, False

    def __init__(self, device):
        self._device = device

    def __getattr__(self, name):
        return getattr(self._device, name)


def taken(condition, *bodies, **named):
    """Instead of conditional nodes of a graph: every branch once."""
    bodies += tuple(
        named.pop(name)
        for name in ("on_true", "on_false", "while_body")
        if name in named
    )
    for body in filter(callable, bodies):
        body(**{name: value for name, value in named.items() if name != "stream"})


wp.launch, wp.launch_tiled = (
    noting_instead_of(wp.launch),
    noting_instead_of(wp.launch_tiled),
)
import mujoco_warp as mjw  # noqa: E402

from taccorl.robots import ROBOT  # noqa: E402
from taccorl.sim import ray_renderer, warp_batch  # noqa: E402
from taccorl.sim.ray_renderer import RayRenderer  # noqa: E402
from taccorl.sim.vector_env import TaccorlVectorEnv  # noqa: E402

ray_renderer.WORLDS_AT_ONCE = 2  # drawn here once, to be made
batch = TaccorlVectorEnv(
    (sys.argv[2:] or ["assembly_1"])[0],
    4,
    physics=",".join(["warp:device=cpu", *sys.argv[4:]]),
    num_threads=2,
).sim.batch
varied = [
    name
    for name in warp_batch.MODEL_FIELDS
    if warp_batch._varies(name) and batch.expanded(name) is not None
]
worlds = warp_batch._Worlds(
    warp_batch._for_warp(batch.model), 2048, batch.settings, varied
)
get_device = wp.get_device
wp.capture_if = wp.capture_while = taken
wp.get_device = lambda *name: Gpu(get_device(*name))
noting = True
mjw.step(worlds._model, worlds._data)
mjw.forward(worlds._model, worlds._data)
wp.launch(warp_batch.kernels.put_targets)
for size in ((84, 112), (224, 224)):
    noting, wp.get_device = False, get_device
    rays = RayRenderer(batch.model, ROBOT.cameras, *size, device="cpu")
    noting, wp.get_device = True, lambda *name: Gpu(get_device(*name))
    rays._work()
noting, wp.get_device = False, get_device
for number, (module, block_dim) in enumerate(noted.values()):
    module.get_module_hash(block_dim)
    options = module.resolve_options(wp.config, block_dim=block_dim)
    arch = int((sys.argv[3:] or ["90"])[0])
    if not any(
        Path(sys.argv[1]).glob(
            f"*/{module.get_module_identifier(block_dim)}/*.sm{arch}.cubin"
        )
    ):
        module._compile(None, None, output_arch=arch, options=options)
    print(f"{number + 1} of {len(noted)}: {module.name}", flush=True)
