"""Options of `meshskin calibrate` that state what is known of the robot."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import ConfigError
from . import body_options
from .options import add_part, check_part, load_skin, option, real, refuse

if TYPE_CHECKING:
    from ..scene.belief import Belief

SCENE_OPTIONS = (
    "body", *body_options.NAMES, "indenter_radius_mm", "young_kpa", "poisson", "thickness_mm",
    "skin_mm",
)  # fmt: skip
"""Options whose values come from the scene when --scene is given."""
PRESSURE_OPTIONS = ("noise_kpa", "threshold_kpa", "saturation_kpa")
"""Options that state pressures."""
NOMINAL_YOUNG_KPA = 200.0
"""Young's modulus at which the estimate from raw readings starts where none is given: that of soft
silicone rubber. It sets the first size of the patch, which is estimated."""
NUMBERS = {
    "--indenter-radius-mm": "radius of the indenter",
    "--young-kpa": "approximate Young's modulus of the skin",
    "--poisson": "Poisson's ratio of the skin (default 0.49)",
    "--thickness-mm": "thickness of the soft layer on a rigid core",
    "--skin-mm": "the body is the surface of a skin of this thickness on the mesh, which bridges "
    "features smaller than 1.5 indenter radii",
    "--disc-radius-mm": "radius of a taxel (default 2)",
    "--noise-kpa": "standard deviation of the noise of a reading",
    "--threshold-kpa": "pressures up to this value are not recorded",
    "--saturation-kpa": "upper end of the sensor's range",
}
"""Options that are numbers."""
POSITIVE = real(above=0.0)
LIMITS = {"--poisson": real(least=0.0, most=0.5), "--threshold-kpa": real(least=0.0)}
"""Types of those that may be zero."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    scene = "name or file of a scene that gives body, indenter and material"
    option(parser, "--scene SCENE", scene)
    known = parser.add_argument_group("known properties of the robot")
    mesh = f"mesh of the body that the skin covers: {body_options.HELP}"
    option(known, "--body --urdf MESH", mesh, Path)
    body_options.add(known)
    for name, words in NUMBERS.items():
        unit = name.rpartition("-")[2].upper()
        option(known, f"{name} {unit}", words, LIMITS.get(name, POSITIVE))
    option(
        known, "--raw", "readings are counts or volts of any scale and sign; the response is "
        f"learned, and --young-kpa only sets its start (default {NOMINAL_YOUNG_KPA:g})",
    )  # fmt: skip
    option(
        known, "--contact CONTACT", "contact model: hertz, elliptic, layered, learned or auto "
        "(default: the first that is valid, or learned where the readings contradict it)",
    )  # fmt: skip
    option(known, "--taxels FILE", "skin file that lists the ids of all taxels", Path)
    add_part(known)
    option(known, "--modules", "taxels lie on rigid triangular modules, id = 12 module + slot")
    option(
        known, "--unknown NAME", "parameters estimated with the taxels: modulus (default), gain, "
        "offset, force_scale, force_offset, indenter_offset, body_offset, drag, friction, "
        "patch_shift", nargs="*",
    )  # fmt: skip
    option(
        known, "--response-groups IDS", "taxels of each further skin or amplifier, whose response "
        "is learned on its own: 48-95,108-119 (default: looked for)", nargs="+",
    )  # fmt: skip


MAX_IDS = 1_000_000
"""Most ids of a range: more than any skin has."""


def _response_groups(options: argparse.Namespace) -> tuple[np.ndarray, ...]:
    """Ids of the taxels of each group of --response-groups. Raises ConfigError."""
    try:
        return tuple(
            np.concatenate([_range(*part.partition("-")) for part in group.split(",")])
            for group in options.response_groups
        )
    except ValueError as error:
        raise ConfigError(
            "--response-groups takes ids and ranges of ids",
            value=" ".join(options.response_groups),
            remedy="write each group as 48-95,108-119",
        ) from error


def _range(first: str, to: str, last: str) -> np.ndarray:
    """Ids from the first to the last, or the first alone. Raises ValueError for other texts."""
    low, high = int(first), int(last if to else first)
    if not 0 <= high - low < MAX_IDS:
        raise ValueError(f"{first}-{last} is not a range of ids")
    return np.arange(low, high + 1)


def belief_of(options: argparse.Namespace, taxel_ids: ArrayLike) -> Belief:
    """The belief that the options describe; taxel_ids (n,): of the log, used where neither a scene
    nor a skin file has them. Raises ConfigError where options are missing.
    """
    from ..scene.belief import RAW
    from ..skin import slots

    if options.raw:
        _check_raw(options)
    check_part(options.part, options.taxels, getattr(options, "previous", None))
    belief = _by_scene(options) if options.scene else _by_options(options)
    kilo = {
        "noise_sigma": options.noise_kpa,
        "threshold": options.threshold_kpa,
        "saturation": options.saturation_kpa,
    }
    changes: dict[str, Any] = {k: 1e3 * v for k, v in kilo.items() if v is not None}
    if options.raw:  # a scene's noise, threshold and saturation are pressures
        changes = {"readings": RAW, "noise_sigma": None, "threshold": 0.0, "saturation": None}
    if options.disc_radius_mm is not None:
        changes["disc_radius"] = 1e-3 * options.disc_radius_mm
    if options.contact is not None:
        changes["contact"] = options.contact
    if options.unknown is not None:
        changes["unknown"] = tuple(options.unknown)
    if options.modules:
        changes["module_slots"] = slots.OFFSETS
    if options.taxels is not None:
        changes["taxel_ids"] = np.array(load_skin(options.taxels, options.part).ids)
    elif not options.scene:
        changes["taxel_ids"] = np.array(taxel_ids, dtype=int)
    if options.response_groups is not None:
        changes["response_groups"] = _response_groups(options)
    return replace(belief, **changes)


def _check_raw(options: argparse.Namespace) -> None:
    """Refuse options that mean nothing for raw readings."""
    from ..contact import AUTO, LEARNED

    contact = ["contact"] if options.contact not in (None, AUTO, LEARNED) else []
    refuse(
        options,
        [*PRESSURE_OPTIONS, *contact, "modules"],
        "raw readings have no unit, and their response is learned for independent taxels, got {} "
        "together with --raw",
        "remove it: noise, threshold and saturation follow from the readings",
    )


def _by_scene(options: argparse.Namespace) -> Belief:
    """The belief of the scene named by --scene."""
    from ..scene.scene import Scene

    exported = getattr(options, "export", None) is not None  # --link names the frame of the map
    names = [name for name in SCENE_OPTIONS if not (exported and name == "link")]
    what = "--scene gives body, indenter and material, got {} together with --scene"
    refuse(options, names, what, "remove either --scene or the other options")
    return Scene.load(options.scene).belief()


def _by_options(options: argparse.Namespace) -> Belief:
    """The belief built from --body, --indenter-radius-mm, --young-kpa and so on."""
    from ..contact import AUTO
    from ..contact.indenter import Indenter
    from ..contact.material import Material
    from ..scene.belief import Belief

    young = NOMINAL_YOUNG_KPA if options.raw and options.young_kpa is None else options.young_kpa
    needed = {
        "--body": options.body,
        "--indenter-radius-mm": options.indenter_radius_mm,
        "--young-kpa": young,
    }
    missing = [name for name, value in needed.items() if value is None]
    if missing:
        raise ConfigError(
            f"required options are missing: {', '.join(missing)}",
            remedy="give --scene, or all of --body (or --urdf and --link), "
            "--indenter-radius-mm and --young-kpa (which --raw does not need)",
        )
    body, indenter = body_options.load(options.body, options), 1e-3 * options.indenter_radius_mm
    if options.skin_mm is not None:
        body = body.skinned(1e-3 * options.skin_mm, 1.5 * indenter)
    poisson = 0.49 if options.poisson is None else options.poisson
    thickness = None if options.thickness_mm is None else 1e-3 * options.thickness_mm
    return Belief(
        body=body,
        indenter=Indenter.sphere(indenter),
        material=Material(1e3 * young, poisson, thickness),
        taxel_ids=np.empty(0, dtype=int),
        contact=AUTO,
    )


def inputs(options: argparse.Namespace) -> dict[str, Any]:
    """Where recording, scene and body are, for metrics.json, from which the page is made again."""
    paths = {"recording": options.recording, "body": options.body}
    scene = options.scene
    if scene is not None and Path(scene).suffix == ".toml":
        paths["scene"], scene = Path(scene), None
    given = {name: str(path.resolve()) for name, path in paths.items() if path is not None}
    given |= {} if scene is None else {"scene": scene}
    own = {name: getattr(options, name) for name in body_options.NAMES}
    own["folder"] = [str(folder.resolve()) for folder in options.folder or ()] or None
    return given | {name: value for name, value in own.items() if value is not None}
