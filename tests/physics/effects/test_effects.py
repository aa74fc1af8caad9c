"""Effects: named in TOML, imported only when named, each with a random stream of its own."""

import subprocess
import sys

import numpy as np
import pytest

from meshskin.errors import ConfigError, UnknownNameError
from meshskin.physics import effects
from meshskin.physics.effects import Context
from meshskin.physics.effects.gaussian_noise import GaussianNoise

CONTEXT = Context(seed=3, peak_pressure=8e4, contact_radius=4e-3)


def test_noise_has_its_standard_deviation_and_no_mean():
    noise = GaussianNoise(0.02).build(CONTEXT)(np.full((500, 80), 1e4)) - 1e4
    assert noise.std() == pytest.approx(1600, rel=0.02)
    assert abs(noise.mean()) < 4 * 1600 / np.sqrt(noise.size)
    neighbours = np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1]
    assert abs(neighbours) < 0.02


def test_noise_does_not_depend_on_the_batches():
    frames = np.zeros((10, 4))
    whole = GaussianNoise().build(CONTEXT)(frames)
    act = GaussianNoise().build(CONTEXT)
    assert np.array_equal(whole, np.vstack([act(frames[:3]), act(frames[3:])]))


def test_streams_differ_by_seed_and_by_name():
    first, again = CONTEXT.stream("gaussian_noise"), CONTEXT.stream("gaussian_noise")
    assert first.random() == again.random()
    others = [CONTEXT.stream("hysteresis"), Context(4, 8e4, 4e-3).stream("gaussian_noise")]
    assert len({g.random() for g in (CONTEXT.stream("gaussian_noise"), *others)}) == 3


def test_bound_grows_with_the_noise():
    assert GaussianNoise(0.01).bound(CONTEXT) == pytest.approx(0.12e-3)


def test_toml_table_makes_the_effect():
    found = effects.from_table({"kind": "gaussian_noise", "sigma_relative": 0.05})
    assert found == GaussianNoise(0.05)
    with pytest.raises(UnknownNameError, match="did you mean gaussian_noise"):
        effects.from_table({"kind": "gausian_noise"})
    with pytest.raises(UnknownNameError, match="sigma_relative"):
        effects.from_table({"kind": "gaussian_noise", "sigma": 0.05})
    with pytest.raises(ConfigError, match="limit: above 0"):
        effects.from_table({"kind": "gaussian_noise", "sigma_relative": -0.1})
    with pytest.raises(ConfigError, match="lacks kind"):
        effects.from_table({"sigma_relative": 0.1})


def test_only_the_stage_asked_for_is_built():
    assert effects.build((), CONTEXT, "transducer") == ()
    assert effects.build((GaussianNoise(),), CONTEXT, "pressure") == ()
    assert len(effects.build((GaussianNoise(),), CONTEXT, "transducer")) == 1


def test_conflicts_are_refused():
    class Drift(GaussianNoise):
        name, stage, requires = "drift", "robot", ("thermometer",)

    class Quiet(GaussianNoise):
        name, stage, excludes = "quiet", "geometry", ("gaussian_noise",)

    with pytest.raises(ConfigError, match="2 times"):
        effects.ordered((GaussianNoise(), GaussianNoise(0.1)))
    with pytest.raises(ConfigError, match="requires thermometer"):
        effects.ordered((Drift(),))
    with pytest.raises(ConfigError, match="quiet excludes gaussian_noise"):
        effects.ordered((GaussianNoise(), Quiet()))


def test_effects_are_ordered_by_stage():
    class Late(GaussianNoise):
        name, stage = "late", "robot"

    assert [e.name for e in effects.ordered((Late(), GaussianNoise()))] == [
        "gaussian_noise",
        "late",
    ]


def test_modules_are_imported_only_when_named():
    code = (
        "import sys; from meshskin.physics import effects; "
        "name = 'meshskin.physics.effects.gaussian_noise'; assert name not in sys.modules; "
        "effects.find('gaussian_noise'); assert name in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
