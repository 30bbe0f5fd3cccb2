"""MuJoCo's own dry friction in the one-joint model, against plain MuJoCo step by step."""

import mujoco
import numpy as np
import pytest

from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate

STEPS = 1500
KP, KD = 20.0, 0.4


def in_mujoco(
    target: np.ndarray, step_s: float, integrator: str, joint: str, gravity: float
) -> tuple[np.ndarray, mujoco.MjModel]:
    """(STEPS,) position before each step of a rod with a position servo, and its model."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
<option timestep="{step_s}" gravity="0 0 {-gravity}"/>
<worldbody><body><joint name="j" {joint}/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.7"/></body></worldbody>
<actuator><position joint="j" kp="{KP}" kv="{KD}"/></actuator></mujoco>""")
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    data, seen = mujoco.MjData(model), []
    for value in target:
        seen.append(data.qpos[0])
        data.ctrl[0] = value
        mujoco.mj_step(model, data)
    return np.array(seen), model


def in_kernel(
    target: np.ndarray, step_s: float, model: mujoco.MjModel, **more: float
) -> np.ndarray:
    """The same by the one-joint model, with numbers of the compiled ``model``."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hinge = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE
    numbers = {
        "inertia": 1.0 / model.dof_invweight0[0] - model.dof_armature[0],
        "armature__added_kgm2": model.dof_armature[0],
        "viscous_friction__damping_nms_per_rad": model.dof_damping[0],
        "soft_friction__torque_nm": model.dof_frictionloss[0],
        "gravity_cos": data.qfrc_bias[0] * hinge,
    }
    still, ones = np.zeros(len(target)), np.ones(len(target))
    held = still + data.qfrc_bias[0] * (not hinge)
    rest = (still, ones, ones, still, 0.0, 1, 1, step_s, 0.0)
    return simulate(Drive(KP, KD, 0.0, **(numbers | more)), target, held, *rest)[0]


def swing(step_s: float) -> np.ndarray:
    """(STEPS,) targets: a wave that grows, and a hold of a third of the time."""
    time_s = step_s * np.arange(STEPS)
    wave = 0.3 * np.sin(2 * np.pi * 1.3 * time_s) * time_s / time_s[-1]
    return np.where(np.arange(STEPS) < 1000, wave, wave[1000])


@pytest.mark.parametrize("step_s", [1 / 1200, 0.002, 0.005])
@pytest.mark.parametrize(
    ("joint", "gravity"),
    [
        ('axis="0 -1 0" frictionloss="0.6"', 0.0),
        ('axis="0 -1 0" frictionloss="0.6" damping="0.3" armature="0.02"', 0.0),
        ('axis="0 -1 0" frictionloss="0.3" damping="0.1" armature="0.01"', 9.81),
        ('axis="0 0 1" type="slide" frictionloss="0.9" damping="0.5"', 0.0),
        ('axis="0 0 1" type="slide" frictionloss="2" armature="0.3"', 1.0),
    ],
)
def test_soft_friction_is_that_of_mujoco(
    joint: str, gravity: float, step_s: float
) -> None:
    target = swing(step_s)
    exact, model = in_mujoco(target, step_s, "DISCRETE", joint, gravity)
    quick = in_kernel(target, step_s, model)
    np.testing.assert_allclose(quick, exact, rtol=0, atol=1e-9)
    rigid = in_kernel(
        target,
        step_s,
        model,
        soft_friction__torque_nm=0.0,
        coulomb_friction__torque_nm=model.dof_frictionloss[0],
    )
    assert np.abs(rigid - exact).max() > 2e-4, "it creeps where Coulomb friction sticks"


@pytest.mark.parametrize("time_s", [0.005, 0.02, 0.08])
def test_its_time_constant_is_that_of_solreffriction(time_s: float) -> None:
    joint = f'axis="0 -1 0" frictionloss="0.6" solreffriction="{time_s} 1"'
    target = swing(0.002)
    exact, model = in_mujoco(target, 0.002, "DISCRETE", joint, 0.0)
    more = {"soft_friction__time_constant_s": time_s}
    quick = in_kernel(target, 0.002, model, **more)
    np.testing.assert_allclose(quick, exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICITFAST"])
def test_midpoint_steps_come_near_other_integrators(integrator: str) -> None:
    """EULER and IMPLICITFAST have errors of first order in the step: with half the step, the
    distance to our midpoint steps is half as large."""
    joint = 'axis="0 -1 0" frictionloss="0.6" damping="0.3" armature="0.02"'
    apart = []
    for step_s in (1e-3, 5e-4):
        target = 0.3 * np.sin(2 * np.pi * 1.3 * step_s * np.arange(STEPS))
        exact, model = in_mujoco(target, step_s, integrator, joint, 0.0)
        quick = in_kernel(target, step_s, model, midpoint=1.0)
        apart.append(np.abs(quick - exact).max())
    assert apart[0] < 2e-3
    assert apart[1] < 0.6 * apart[0]


def test_beside_rigid_friction_both_are_solved_together() -> None:
    """A tendon about the joint has the soft friction, the joint itself the rigid one."""
    step_s = 0.002
    target = swing(step_s)
    spec = mujoco.MjSpec.from_string("""<mujoco><option timestep="0.002" gravity="0 0 0"/>
<worldbody><body><joint name="j" axis="0 -1 0" frictionloss="0.2" damping="0.1"
solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.7"/></body></worldbody>
<tendon><fixed frictionloss="0.5"><joint joint="j" coef="1"/></fixed></tendon>
<actuator><position joint="j" kp="20" kv="0.4"/></actuator></mujoco>""")
    model = spec.compile()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    data, seen = mujoco.MjData(model), []
    for value in target:
        seen.append(data.qpos[0])
        data.ctrl[0] = value
        mujoco.mj_step(model, data)
    quick = in_kernel(
        target,
        step_s,
        model,
        soft_friction__torque_nm=0.5,
        coulomb_friction__torque_nm=0.2,
    )
    np.testing.assert_allclose(quick, seen, rtol=0, atol=1e-6)
