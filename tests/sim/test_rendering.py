"""Pictures against the pinhole model and against ingest; the same bytes alone and among others; no OpenGL, said plainly."""

import dataclasses
import gc
import textwrap
import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from taccorl.data.pictures import letterbox
from taccorl.errors import TaccorlError
from taccorl.sim.cameras import (
    CameraConfig,
    Intrinsics,
    add_cameras,
    bench_cameras,
    letterbox_window,
    project,
)
from taccorl.sim.rendering import Renderer, style
from tests.fresh_python import fresh_python

NAMES = ("front", "left_wrist", "right_wrist")
SPOTS = {  # world positions that all three cameras see, and their colours
    (0.34, 0.05, 0.03): (255, 0, 0),
    (0.40, -0.06, 0.08): (0, 255, 0),
    (0.28, -0.02, 0.10): (0, 0, 255),
    (0.36, 0.12, 0.02): (255, 255, 0),
}
REPOSITORY = Path(__file__).parents[2]


def hands(spec: mujoco.MjSpec) -> None:
    """Two bodies for the wrist cameras, above the table and looking down."""
    for arm, side in (("left", 0.1), ("right", -0.1)):
        body = spec.worldbody.add_body(
            name=f"{arm}_link6", pos=[0.3, side, 0.32], quat=[0, 1, 0, 0]
        )
        body.add_joint(name=f"{arm}_joint", axis=[0, 1, 0.5])
        body.add_geom(
            size=[0.004, 0, 0], pos=[0, 0, 0.05], mass=0.1, group=3
        )  # not drawn


def letterboxed(config: CameraConfig, rows: int, columns: int) -> Intrinsics:
    camera = config.recorded_intrinsics()
    window = letterbox_window((camera.rows, camera.columns), (rows, columns))
    inner = camera.scaled(window.rows, window.columns)
    return dataclasses.replace(
        inner, cx_px=inner.cx_px + window.left, cy_px=inner.cy_px + window.top
    )


def spots(
    cameras: tuple[CameraConfig, ...] = bench_cameras(), radius_m: float = 0.008
) -> mujoco.MjModel:
    """Small glowing spheres before nothing."""
    spec = mujoco.MjSpec()
    hands(spec)
    for k, (position, color) in enumerate(SPOTS.items()):
        glow = spec.add_material(
            name=f"glow{k}",
            emission=1.0,
            specular=0.0,
            rgba=[*(c / 255 for c in color), 1],
        )
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius_m, 0, 0],
            pos=position,
            material=glow.name,
        )
    add_cameras(spec, cameras)
    return spec.compile()


def clutter(with_style: bool = True) -> mujoco.MjSpec:
    """A table with boxes, cylinders, spheres, that fall and are lit: many edges."""
    spec = mujoco.MjSpec()
    rng = np.random.default_rng(3)
    box, round_, ball = (
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_SPHERE,
    )
    spec.worldbody.add_geom(
        name="table",
        type=box,
        size=[0.5, 0.6, 0.02],
        pos=[0.35, 0, -0.02],
        rgba=[0.8, 0.75, 0.65, 1],
    )
    hands(spec)
    for k in range(24):
        body = spec.worldbody.add_body(
            name=f"part{k}",
            pos=[*rng.uniform((0.15, -0.25), (0.6, 0.25)), 0.04 + 0.01 * k],
        )
        body.add_freejoint()
        color = [*rng.uniform(0.1, 0.9, 3), 1]
        body.add_geom(
            name=f"part{k}",
            type=(box, round_, ball)[k % 3],
            size=[0.02, 0.025, 0.015],
            rgba=color,
        )
        body.add_site(name=f"site{k}", size=[0.03, 0.03, 0.03], rgba=[1, 0, 1, 1])
    add_cameras(spec, bench_cameras())
    following = mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM
    spec.worldbody.add_camera(
        name="follow", pos=[0.4, 0.3, 0.5], mode=following, targetbody="left_link6"
    )
    if with_style:
        style(spec)
    return spec


def states(model: mujoco.MjModel, count: int) -> list[mujoco.MjData]:
    rng = np.random.default_rng(5)
    datas = []
    for _ in range(count):
        data = mujoco.MjData(model)
        data.qpos[:2] = rng.uniform(-0.4, 0.4, 2)
        for k in range(24):
            quat = rng.normal(size=4)
            data.joint(int(model.body(f"part{k}").jntadr[0])).qpos[3:] = (
                quat / np.linalg.norm(quat)
            )
        mujoco.mj_forward(model, data)
        datas.append(data)
    return datas


@pytest.fixture(scope="module", autouse=True)
def opengl():
    try:
        with Renderer(spots(), ["front"]) as renderer:
            _ = renderer.driver
    except TaccorlError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def cluttered() -> tuple[mujoco.MjModel, list[mujoco.MjData], np.ndarray]:
    """A model, 14 states, and their 42 pictures drawn together."""
    model = clutter().compile()
    datas = states(model, 14)
    with Renderer(model, NAMES) as renderer:
        return model, datas, renderer.render(datas)


def centre_of(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Mean (u, v) of the pixels of one glowing spot."""
    v, u = np.nonzero((np.abs(picture.astype(int) - color) < 40).all(-1))
    assert len(u) >= 3, f"spot {color} is not in the picture"
    return np.array([u.mean(), v.mean()])


def unusual_front() -> CameraConfig:
    """Measured intrinsics: fx ≠ fy, principal point off the centre by 14 and 11 pixels."""
    measured = Intrinsics(
        rows=480, columns=640, fx_px=610.0, fy_px=628.0, cx_px=333.5, cy_px=228.5
    )
    return dataclasses.replace(bench_cameras()[0], intrinsics=measured)


# A sphere's picture is off its centre's by f·tan θ·(radius/depth)², so spheres shrink as pictures grow.
@pytest.mark.parametrize(
    ("shape", "radius_m"),
    [((224, 224), 0.008), ((480, 640), 0.005), ((96, 130), 0.012), ((150, 96), 0.012)],
)
@pytest.mark.parametrize(
    "front", [bench_cameras()[0], unusual_front()], ids=["nominal", "measured"]
)
def test_a_point_lands_on_the_pixel_that_the_pinhole_model_says(shape, radius_m, front):
    cameras = (front, *bench_cameras()[1:])
    model = spots(cameras, radius_m)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with Renderer(model, NAMES, *shape) as renderer:
        pictures = renderer.render([data])[0]
    errors = []
    for config, picture in zip(cameras, pictures, strict=True):
        camera = data.camera(config.name)
        intrinsics = letterboxed(config, *shape)
        for position, color in SPOTS.items():
            expected = project(
                np.array(position), camera.xpos, camera.xmat.reshape(3, 3), intrinsics
            )
            errors.append(centre_of(picture, color) - expected)
            assert np.abs(errors[-1]).max() < 0.5, (config.name, color)
    assert (
        np.abs(np.mean(errors, axis=0)).max() < 0.2
    )  # 12 spots: no half pixel is lost


def test_bars_are_black_and_the_picture_between_them_is_full(cluttered):
    pictures = cluttered[2]
    assert pictures.shape == (14, 3, 224, 224, 3) and pictures.dtype == np.uint8
    assert not pictures[:, :, :28].any() and not pictures[:, :, 196:].any()
    assert pictures[:, :, 28:196].max(-1).min() > 0


def test_drawing_at_224_is_what_ingest_makes_of_a_640_480_recording(cluttered):
    model, datas, pictures = cluttered
    with Renderer(model, NAMES, 480, 640) as renderer:
        recorded = renderer.render(datas[:2])
    for drawn, full in zip(
        pictures[:2].reshape(-1, 224, 224, 3),
        recorded.reshape(-1, 480, 640, 3),
        strict=True,
    ):
        stored = letterbox(full, 224, 224).astype(int)

        def difference(down: int, right: int, drawn=drawn, stored=stored) -> float:
            return np.abs(np.roll(drawn, (down, right), (0, 1)).astype(int) - stored)[
                40:184, 12:212
            ].mean()

        here = difference(0, 0)
        assert (
            here < 3.0
        )  # edges only: ingest averages pixels, the renderer takes the nearest
        assert all(
            difference(*step) > 1.5 * here
            for step in ((1, 0), (-1, 0), (0, 1), (0, -1))
        )


def test_a_picture_is_the_same_bytes_alone_and_among_others(cluttered):
    model, datas, together = cluttered
    with Renderer(model, NAMES) as renderer:
        alone = np.concatenate([renderer.render([data]) for data in datas])
        backwards = renderer.render(datas[::-1])
    assert np.array_equal(alone, together)
    assert np.array_equal(backwards[::-1], together)
    with Renderer(model, ["right_wrist", "front"]) as renderer:
        assert np.array_equal(renderer.render(datas[3:5]), together[3:5][:, [2, 0]])


@pytest.mark.parametrize(
    "max_sheet_px", [224, 460, 1000]
)  # one cell, 2 × 2 cells, 5 × 4 cells a sheet
def test_more_views_than_a_sheet_holds_are_drawn_in_chunks(
    cluttered, max_sheet_px: int
):
    model, datas, together = cluttered
    with Renderer(model, NAMES, max_sheet_px=max_sheet_px) as renderer:
        assert np.array_equal(renderer.render(datas), together)


def test_a_view_larger_than_any_sheet_is_refused(cluttered):
    model, datas, _ = cluttered
    with (
        Renderer(model, NAMES, max_sheet_px=200) as renderer,
        pytest.raises(TaccorlError, match="168×224 pixels"),
    ):
        renderer.render(datas[:1])


@pytest.mark.parametrize(
    "max_sheet_px", [4096, 700, 460]
)  # rows of 8, 3 and 2 cells: cameras change places
def test_cameras_of_unlike_shape_share_a_sheet(max_sheet_px: int):
    wide = dataclasses.replace(bench_cameras()[1], recording_size=(480, 848))
    model = spots((bench_cameras()[0], wide))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with Renderer(
        model, ["front", "left_wrist"], max_sheet_px=max_sheet_px
    ) as renderer:
        pictures = renderer.render([data] * 4)
    for column, name in enumerate(("front", "left_wrist")):
        with Renderer(model, [name]) as renderer:
            assert np.array_equal(
                renderer.render([data] * 4)[:, 0], pictures[:, column]
            )
    camera = data.camera("left_wrist")
    intrinsics = letterboxed(wide, 224, 224)
    for position, color in SPOTS.items():
        expected = project(
            np.array(position), camera.xpos, camera.xmat.reshape(3, 3), intrinsics
        )
        assert np.abs(centre_of(pictures[1, 1], color) - expected).max() < 0.5


def test_pictures_are_copies_and_no_simulations_make_no_pictures(cluttered):
    model, datas, together = cluttered
    with Renderer(model, NAMES) as renderer:
        first = renderer.render(datas[:1])
        renderer.render(datas[1:2])
        assert np.array_equal(first, together[:1])
        assert renderer.render([]).shape == (0, 3, 224, 224, 3)


def test_a_batch_is_drawn_as_its_states_and_models_are(cluttered):
    model, datas, together = cluttered
    batch = Batch(model, nsim=4, nthread=1)
    batch.bind("qpos")[:] = np.stack([data.qpos for data in datas[:4]])
    with Renderer(model, NAMES) as renderer:
        assert np.array_equal(renderer.render_batch(batch), together[:4])
        assert np.array_equal(renderer.render_batch(batch, [1, 3]), together[[1, 3]])
        assert np.array_equal(
            renderer.render_batch(batch, np.array([True, False, False, True])),
            together[[0, 3]],
        )
        with Renderer(
            model, ["follow"]
        ) as other:  # a camera that needs more of a state than its poses
            assert np.array_equal(other.render_batch(batch), other.render(datas[:4]))
        # Sim 2 gets a white part 0 and a front camera 5 cm higher; the others stay as they are.
        batch.expand("geom_rgba")[2, model.geom("part0").id] = 1.0
        batch.expand("cam_pos")[2, model.camera("front").id, 2] += 0.05
        changed = renderer.render_batch(batch)
        mine = batch.get_model(2)
        data = mujoco.MjData(mine)
        data.qpos[:] = datas[2].qpos
        mujoco.mj_forward(mine, data)
        assert np.array_equal(changed[2], renderer.render([data])[0])
    assert np.array_equal(changed[[0, 1, 3]], together[[0, 1, 3]])
    assert (changed[2, 0] != together[2, 0]).mean() > 0.05


def test_shadows_reflections_and_sites_are_not_drawn_and_the_model_is_left_alone():
    spec = clutter(with_style=False)
    spec.worldbody.add_light(name="lamp", pos=[0.3, 0, 1.5], castshadow=True)
    spec.add_material(name="mirror", reflectance=0.7)
    spec.geom("table").material = "mirror"
    model = spec.compile()
    datas = states(model, 1)
    with Renderer(model, NAMES) as renderer:
        asked = renderer.render(datas)
        model.light_castshadow[:] = 0
        model.mat_reflectance[:] = 0
        model.site_size[:] = 0.1
        model.site_rgba[:] = 1
        assert np.array_equal(renderer.render(datas), asked)
        model.geom_rgba[:, 0] = 0  # what is drawn does follow the model
        assert not np.array_equal(renderer.render(datas), asked)
    assert (
        model.vis.quality.offsamples == 4 and model.vis.quality.shadowsize == 4096
    )  # MuJoCo's defaults


def test_close_frees_and_another_picture_opens_again(cluttered):
    model, datas, together = cluttered
    renderer = Renderer(model, NAMES)
    renderer.close()  # nothing is open yet
    assert np.array_equal(renderer.render(datas[:1]), together[:1])
    renderer.close()
    renderer.close()
    assert np.array_equal(renderer.render(datas[:1]), together[:1])
    del renderer
    gc.collect()
    with (
        Renderer(model, NAMES) as one,
        Renderer(model, NAMES) as other,
    ):  # two contexts, in turns
        assert np.array_equal(one.render(datas[:1]), together[:1])
        assert np.array_equal(other.render(datas[1:2]), together[1:2])
        assert np.array_equal(one.render(datas[2:3]), together[2:3])


def test_a_renderer_may_be_used_from_another_thread(cluttered):
    model, datas, together = cluttered
    drawn = []
    with Renderer(model, NAMES) as renderer:
        renderer.render(datas[:1])
        thread = threading.Thread(
            target=lambda: drawn.append(renderer.render(datas[1:2]))
        )
        thread.start()
        thread.join(timeout=30)
        assert np.array_equal(renderer.render(datas[2:3]), together[2:3])
    assert np.array_equal(drawn[0], together[1:2])


def test_an_unknown_camera_and_a_model_with_other_assets_are_named(cluttered):
    model, datas, _ = cluttered
    with pytest.raises(
        TaccorlError, match=r"no camera 'left_wirst'.*did you mean 'left_wrist'"
    ):
        Renderer(model, ["front", "left_wirst"])
    other = spots()
    data = mujoco.MjData(other)
    mujoco.mj_forward(other, data)
    with Renderer(model, NAMES) as renderer:
        with pytest.raises(TaccorlError, match="make a renderer for each"):
            renderer.render([datas[0], data])
        assert renderer.render(datas[:1]).any()  # and goes on


DRAW = """
    import os, sys, mujoco
    from taccorl.errors import TaccorlError
    from taccorl.sim.cameras import CameraConfig, add_cameras, bench_cameras
    from taccorl.sim.rendering import Renderer
    assert not any(name.split(".")[0] == "OpenGL" for name in sys.modules), "OpenGL is loaded before a picture is wanted"
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(size=[0.3, 0, 0])
    add_cameras(spec, bench_cameras()[:1])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    def draw():
        try:
            with Renderer(model, ["front"]) as renderer:
                return f"drew {int(renderer.render([data]).max())}"
        except TaccorlError as error:
            return f"TaccorlError: {error}"
"""


def in_a_process(script: str, **variables: str) -> str:
    code = textwrap.dedent(DRAW) + textwrap.dedent(script)
    done = fresh_python(
        "-c", code, without=("MUJOCO_GL", "PYOPENGL_PLATFORM"), **variables
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_a_driver_the_debian_packages_are_named():
    nothing = str(REPOSITORY / "no_such_folder")
    said = in_a_process("print(draw())", __EGL_VENDOR_LIBRARY_DIRS=nothing)
    assert said.startswith("TaccorlError: pictures cannot be drawn: EGL opens neither")
    assert (
        "apt-get install libegl1 libgl1-mesa-dri" in said
        and "Everything but images works" in said
    )


def test_without_libegl_the_library_is_named():
    hide = """
        import ctypes, ctypes.util
        find, load = ctypes.util.find_library, ctypes.CDLL.__init__
        ctypes.util.find_library = lambda name: None if "EGL" in name else find(name)
        def refuse(self, name, *args, **kwargs):
            if name and "EGL" in str(name):
                raise OSError(f"{name}: cannot open shared object file")
            load(self, name, *args, **kwargs)
        ctypes.CDLL.__init__ = refuse
        print(draw())
    """
    said = in_a_process(hide)
    assert (
        "libEGL.so.1 is not installed. On Debian: apt-get install libegl1 libgl1-mesa-dri"
        in said
    )


@pytest.mark.parametrize(
    ("variables", "named"),
    [
        ({"MUJOCO_GL": "disable"}, "MUJOCO_GL=disable switches OpenGL off"),
        (
            {"PYOPENGL_PLATFORM": "osmesa"},
            "PYOPENGL_PLATFORM=osmesa keeps EGL out. Unset it",
        ),
    ],
)
def test_a_variable_that_forbids_opengl_is_named(variables: dict[str, str], named: str):
    assert named in in_a_process("print(draw())", **variables)


def test_workers_draw_before_and_after_a_fork_or_say_why_they_cannot():
    fork = """
        def child():
            read, write = os.pipe()
            if os.fork() == 0:
                os.write(write, draw().encode())
                os._exit(0)
            os.wait()
            return os.read(read, 1000).decode()
        print(child())
        print(draw())
        print(child())
        kept = Renderer(model, ["front"])
        kept.render([data])
        sys.stdout.flush()  # else the child has these lines in its buffer, too, and prints them again
        if os.fork() == 0:
            try:
                kept.render([data])
            except TaccorlError as error:
                print("kept", error)
            kept.close()
            sys.stdout.flush()
            os._exit(0)
        print(os.wait()[1])
        print(draw())
    """
    first, parent, second, kept, status, again = in_a_process(fork).splitlines()
    assert (
        first == parent == again
        and first.startswith("drew")
        and int(first.split()[1]) > 50
    )
    assert (
        second.startswith(
            "TaccorlError: pictures were drawn before this process was forked"
        )
        and "spawn" in second
    )
    assert (
        kept.startswith("kept pictures were drawn before this process was forked")
        and status == "0"
    )


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("osmesa", ["MUJOCO_GL=osmesa does not load", "apt-get install libosmesa6"]),
        ("foo", ["TaccorlError: MUJOCO_GL=foo", "Set egl, or unset it"]),
    ],
)
def test_a_library_that_mujoco_gl_asks_for_and_is_not_there_is_named(
    value: str, said: list[str]
):
    if (
        fresh_python(
            "-c", "import mujoco", without=("PYOPENGL_PLATFORM",), MUJOCO_GL=value
        ).returncode
        == 0
    ):
        pytest.skip("libOSMesa is installed here")
    done = fresh_python(
        "-c",
        "import taccorl.sim.simulation",
        without=("PYOPENGL_PLATFORM",),
        MUJOCO_GL=value,
    )
    assert all(text in done.stderr for text in said)


@pytest.mark.slow
def test_demonstrations_without_images_need_no_opengl(tmp_path):
    words = [
        "-m",
        "taccorl.cli.main",
        "collect",
        "--task=assembly_1",
        "--episodes=1",
        "--images=false",
    ]
    words += [f"--out={tmp_path / 'out'}", f"--store={tmp_path / 'store'}"]
    done = fresh_python(*words, without=("PYOPENGL_PLATFORM",), MUJOCO_GL="disable")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "meta" / "info.json").is_file()
