"""Models of one free body, of geoms written as XML and prisms given by their outlines."""

import mujoco
import numpy as np


def model_of(geoms: str, meshes: dict[str, np.ndarray] | None = None) -> mujoco.MjModel:
    assets = "".join(
        f'<mesh name="{name}" vertex="{" ".join(map(repr, v.ravel().tolist()))}"/>'
        for name, v in (meshes or {}).items()
    )
    body = f'<body name="part"><freejoint/>{geoms}</body>'
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{assets}</asset><worldbody>{body}</worldbody></mujoco>"
    )


def prism_vertices(outline_m: np.ndarray, low_m: float, high_m: float) -> np.ndarray:
    return np.concatenate(
        [
            np.column_stack([outline_m, np.full(len(outline_m), z)])
            for z in (low_m, high_m)
        ]
    )
