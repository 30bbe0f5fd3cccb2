"""Model files of others: what is wrong is named in one line with its line; what would never end is refused at once."""

import math
import os
import time
from pathlib import Path

import pytest

from taccorl.alignment.machines import model_xml
from taccorl.alignment.machines.model_xml import read_model
from taccorl.alignment.machines.robot_model import load_robot_model
from taccorl.diagnosis.machines.load import load_machine
from taccorl.errors import TaccorlError

INERTIA = 'ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"'


def link(name: str, inertia: str = INERTIA) -> str:
    return (
        f'<link name="{name}">\n<visual>\n<!-- a\ncomment -->\n<geometry><box size="1 1 1"/></geometry></visual>\n'
        '<collision><geometry><box size="1 1 1"/></geometry></collision>'
        f'<inertial><origin xyz="0 0 0.1"/><mass value="1"/><inertia {inertia}/></inertial></link>\n'
    )


def joint(
    name: str,
    parent: str,
    child: str,
    limit: str = 'lower="-1" upper="1"',
    at: str = "0 0 0",
    kind: str = "revolute",
):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="0 0 1"/>\n<limit {limit} effort="5" velocity="1"/></joint>\n'
    )


def urdf(folder: Path, *parts: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(
        '<?xml version="1.0"?>\n<!-- exported\n-->\n<robot name="r">\n<link name="base"/>\n'
        + "".join(parts)
        + "</robot>\n"
    )
    return path


def line_of(path: Path, words: str, which: int = 0) -> int:
    return [
        k for k, line in enumerate(path.read_text().splitlines(), 1) if words in line
    ][which]


def test_two_joints_of_one_name_are_named_with_their_links_and_lines(tmp_path: Path):
    path = urdf(
        tmp_path, link("a"), link("b"), joint("j", "base", "a"), joint("j", "a", "b")
    )
    first, second = line_of(path, 'name="j"'), line_of(path, 'name="j"', 1)
    with pytest.raises(
        TaccorlError,
        match=rf"arm\.urdf:{second}: .*'j'.*base → a \(line {first}\).*a → b",
    ):
        load_robot_model(path)


def test_two_links_or_mjcf_joints_of_one_name_are_refused(tmp_path: Path):
    with pytest.raises(
        TaccorlError, match=r"arm\.urdf:\d+: two <link> have the name 'a'"
    ):
        load_robot_model(urdf(tmp_path, link("a"), link("a"), joint("j", "base", "a")))
    path = tmp_path / "arm.xml"
    body = '<body name="{}"><joint name="j"/><geom size="0.1"/>{}</body>'
    path.write_text(
        f"<mujoco><worldbody>\n{body.format('a', chr(10) + body.format('b', ''))}</worldbody></mujoco>"
    )
    with pytest.raises(
        TaccorlError,
        match=r"arm\.xml:3: two <joint> .*'j'.*world → a \(line 2\).*a → b",
    ):
        load_robot_model(path)


@pytest.mark.parametrize(
    ("degrees", "remarks"),
    [(170.0, 1), (math.degrees(6.28) / 1e3, 0), (20.0, 1), (18.0, 0)],
)
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_limits_of_many_turns_are_probably_degrees(
    tmp_path: Path, degrees: float, remarks: int, kind: str
):
    """3 turns are 18.85 rad; a slide has no turns."""
    path = urdf(
        tmp_path,
        link("a"),
        joint("j", "base", "a", f'lower="{-degrees}" upper="{degrees}"', kind=kind),
    )
    found = [r for r in load_robot_model(path).remarks if "degrees" in r]
    assert len(found) == (remarks if kind == "revolute" else 0)
    if found:
        assert (
            f"line {line_of(path, '<limit')}" in found[0]
            and f"{math.radians(degrees):.4g}" in found[0]
        )


@pytest.mark.parametrize(
    "moments", [("1.5e-6", "2e-7", "8e-7"), ("1e-9", "1", "2"), ("0.1", "-0.1", "0.1")]
)
def test_an_inertia_that_no_body_has_is_named_with_its_link_line_and_numbers(
    tmp_path: Path, moments: tuple[str, str, str]
):
    inertia = 'ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"'.format(*moments)
    path = urdf(
        tmp_path,
        link("a"),
        link("b", inertia),
        joint("j", "base", "a"),
        joint("k", "a", "b"),
    )
    with pytest.raises(
        TaccorlError, match=rf"arm\.urdf:{line_of(path, '<inertia ixx', 1)}: link b"
    ) as found:
        load_robot_model(path)
    text = str(found.value)
    assert (
        all(f"{float(x):.4g}" in text for x in moments)
        and 'balanceinertia="true"' in text
    )


@pytest.mark.parametrize("at", ["0,1 0 0", "0 0", "a b c"])
def test_lines_are_those_of_the_file_with_its_shapes_and_comments(
    tmp_path: Path, at: str
):
    path = urdf(tmp_path, link("a"), joint("j", "base", "a", at=at))
    with pytest.raises(
        TaccorlError, match=rf"arm\.urdf:{line_of(path, f'xyz="{at}"')}: "
    ):
        load_robot_model(path)


def nested(count: int, times: int, inner: str) -> str:
    for _ in range(times):
        inner = f'<replicate count="{count}" offset="1 0 0">{inner}</replicate>'
    return inner


BODY = '<body><joint name="j"/><geom size="0.1"/>{}</body>'
CHAIN = "".join(link(f"l{k}") for k in range(3000))
HOSTILE = {
    "replicate.xml": f"<mujoco><worldbody>{BODY.format(nested(100, 6, "<geom size='0.1'/>"))}</worldbody></mujoco>",
    "around.xml": f"<mujoco><worldbody>{nested(100, 6, "<body><geom size='0.1'/></body>")}{BODY.format('')}</worldbody></mujoco>",
    "hfield.xml": f'<mujoco><asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset><worldbody>'
    f"{BODY.format('')}</worldbody></mujoco>",
    "texture.xml": '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>'
    f"<worldbody>{BODY.format('')}</worldbody></mujoco>",
    "composite.xml": f'<mujoco><worldbody>{BODY.format("")}<body><composite type="cable" count="100000 100000 1" size="1"/>'
    "</body></worldbody></mujoco>",
    "user.xml": f'<mujoco><size nuser_body="1000000000"/><worldbody>{BODY.format("")}</worldbody></mujoco>',
    "includes.xml": f'<mujoco><include file="includes.xml"/><worldbody>{BODY.format("")}</worldbody></mujoco>',
    "deep.xml": "<mujoco><worldbody>"
    + "".join(f'<body><joint name="j{k}"/><geom size="0.1"/>' for k in range(2000))
    + "</body>" * 2000
    + "</worldbody></mujoco>",
    "deep.urdf": f'<robot name="r">{CHAIN}{"".join(joint(f"j{k}", f"l{k - 1}", f"l{k}") for k in range(1, 3000))}</robot>',
    "ring.urdf": f'<robot name="r">{link("a")}{link("b")}{joint("j", "a", "b")}{joint("k", "b", "a")}</robot>',
    "wide.urdf": f'<robot name="r">{CHAIN}{"".join(joint(f"j{k}", "l0", f"l{k}") for k in range(1, 3000))}</robot>',
    "entities.xml": '<!DOCTYPE m [<!ENTITY e0 "aaaaaaaaaa">'
    + "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 10))
    + f']><mujoco model="&e9;"><worldbody>{BODY.format("")}</worldbody></mujoco>',
    "name.urdf": f'<robot name="r">{link("a")}{link("b")}{joint("&lt;img src=x onerror=alert(1)&gt;", "a", "b")}</robot>',
    "steers.urdf": f'<robot name="r">{link("a")}{link("b")}{joint("j&#x9b;2J", "a", "b")}</robot>',
}


@pytest.mark.parametrize("name", HOSTILE)
def test_models_that_would_never_end_or_steer_are_refused_at_once_in_one_line(
    name: str, tmp_path: Path
):
    (tmp_path / name).write_text(HOSTILE[name])
    began = time.process_time()
    with pytest.raises(TaccorlError) as found:
        load_robot_model(tmp_path / name)
    text = str(found.value)
    assert (
        "\n" not in text
        and text.isprintable()
        and text.startswith(str(tmp_path / name))
        and len(text) < 600
    )
    assert time.process_time() - began < 5.0


GEOM = "<body><geom size='1'/></body>"
HFIELD = "<hfield name='h' nrow='6' ncol='6' size='1 1 1 1'/>"
LIMITS = {
    "elements": ("MOST_ELEMENTS", 20, "<site/>" * 30, ""),
    "sites": ("MOST_MADE", 20, "<replicate count='30'><site/></replicate>", ""),
    "bodies": ("MOST_MADE", 20, f"<replicate count='30'>{GEOM}</replicate>", ""),
    "cable": (
        "MOST_JOINTS",
        20,
        "<body><composite type='cable' count='30 1 1' size='1'/></body>",
        "",
    ),
    "joints": (
        "MOST_JOINTS",
        20,
        f"<replicate count='30'>{GEOM.replace('<geom', '<joint/><geom')}</replicate>",
        "",
    ),
    "hfield": ("MOST_VALUES", 30, "", f"<asset>{HFIELD}</asset>"),
    "mesh": (
        "MOST_VALUES",
        80,
        "",
        "<asset><mesh name='m' builtin='plate' params='9 9'/></asset>",
    ),
    "keys": ("MOST_VALUES", 100, "", "<size nkey='50'/>"),
    "user": ("MOST_VALUES", 100, "", "<size nuser_body='50'/>"),
}


@pytest.mark.parametrize("name", LIMITS)
def test_what_counts_and_sizes_make_together_has_a_limit(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A harmless file, which passes with the usual limit, and not with a lower one."""
    limit, value, inside, beside = LIMITS[name]
    path = tmp_path / "arm.xml"
    path.write_text(
        f"<mujoco>{beside}<worldbody>{BODY.format('')}{inside}</worldbody></mujoco>"
    )
    read_model(path)
    monkeypatch.setattr(model_xml, limit, value, raising=False)
    with pytest.raises(TaccorlError, match=r"arm\.xml:1: <\w+.*more than"):
        read_model(path)


@pytest.mark.parametrize("encoding", ["utf-7", "big5", "zlib", "idna", "none-such"])
def test_an_encoding_that_is_not_read_is_named(encoding: str, tmp_path: Path):
    path = tmp_path / "arm.urdf"
    text = f"<robot name='r'>{link('a')}{link('b')}{joint('j', 'a', 'b')}</robot>"
    path.write_text(f"<?xml version='1.0' encoding='{encoding}'?>{text}")
    with pytest.raises(TaccorlError, match=r"arm\.urdf:1: .*encoding.*UTF-8"):
        load_robot_model(path)


def test_names_in_another_encoding_than_utf_8_are_refused(tmp_path: Path) -> None:
    """MuJoCo keeps the bytes of a name as they are."""
    body = BODY.format("").replace('"j"', '"jé"')
    text = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    stated = f"<?xml version='1.0' encoding='latin-1'?>{text}"
    (tmp_path / "arm.xml").write_bytes(stated.encode("latin-1"))
    with pytest.raises(TaccorlError, match=r"arm\.xml: .*save it as UTF-8"):
        load_robot_model(tmp_path / "arm.xml")


def test_the_memory_that_a_model_asks_for_is_not_taken(tmp_path: Path):
    (tmp_path / "arm.xml").write_text(
        f'<mujoco><size memory="900G"/><worldbody>{BODY.format("")}</worldbody></mujoco>'
    )
    assert list(load_robot_model(tmp_path / "arm.xml").joints) == ["j"]


@pytest.mark.parametrize("what", ["pipe", "zero"])
def test_devices_and_pipes_are_no_files(what: str, tmp_path: Path):
    path = tmp_path / "arm.urdf"
    if what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    for load in (load_robot_model, load_machine):
        with pytest.raises(TaccorlError, match=r"arm\.urdf: is "):
            load(path)


@pytest.mark.parametrize(
    "text",
    [
        "physics: {steps_per_control_step: 1000000000000}",
        "physics: {steps_per_control_step: 2020}",
        "kind: cells\nname: skin\nrows: 1000000\ncolumns: 1000000\nreading: {unit: count}\nload: {unit: N, rated: 1.0}",
        "kind: axis\nname: 'a<b'\nunit: rad\ninertia: 1.0\nkp: 1.0\nkd: 1.0",
    ],
)
def test_numbers_and_names_of_machine_files_have_bounds(text: str, tmp_path: Path):
    (tmp_path / "twin.yaml").write_text(text + "\n")
    with pytest.raises(TaccorlError, match=r"twin\.yaml:\d+: "):
        load_machine(tmp_path / "twin.yaml")
