"""What the networks of SpongeCake are made with: samples, lobes as they are trained, a training that goes on."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.precompute.learning import Schedule
from layerjax.precompute.spongecake import data, energy_correction, training
from layerjax.precompute.spongecake import maker as spongecake
from layerjax.tables import load
from layerjax.transport.spongecake.lobes import BlurredSGGX, evaluate_second, second_lobe
from layerjax.transport.spongecake.mapping import network, pack, unpack
from layerjax.transport.spongecake.transport import networks


def drawn(media, shards=3, seed=1):
    """Materials and directions as they are drawn, values made up."""
    random = np.random.default_rng(seed)
    parts = [data.draw_layers(random, media, data.SHARD)[0] for _ in range(shards)]
    layers = data.LayerParameters(
        *(np.concatenate(each) for each in zip(*(vars(p).values() for p in parts), strict=True))
    )
    wi, wo = data.draw_directions(random, len(layers.alpha))
    values = 0.05 * random.uniform(size=wo.shape[:-1])
    return data.Samples(layers, *(array.astype(np.float32) for array in (wi, wo, values)))


def test_a_kind_by_its_number_is_the_phase_function_itself():
    axis, alpha, blur = jnp.array([0.36, 0.48, 0.8]), jnp.asarray(0.3), jnp.asarray(0.2)
    wi, wo = np.random.default_rng(5).normal(size=(2, 3, 200))
    wi, wo = (tuple(jnp.asarray(w / np.linalg.norm(w, axis=0))) for w in (wi, wo))
    phases = [BlurredSGGX("surface", alpha, axis, blur), BlurredSGGX("fiber", alpha, axis, blur)]
    for kind, phase in zip(np.eye(3), [*phases, lj.HenyeyGreenstein(alpha)], strict=True):
        numbered = training.PhaseOfKind(jnp.asarray(kind), alpha, axis, blur)
        np.testing.assert_array_equal(numbered.cross_section(wi), phase.cross_section(wi))
        np.testing.assert_array_equal(numbered.kernel(wi, wo, None), phase.kernel(wi, wo, None))


@pytest.mark.slow
@pytest.mark.parametrize("media", [1, 2])
def test_the_lobes_that_are_trained_are_those_of_the_transport(media):
    samples, net = drawn(media), network(media, jax.random.key(4))
    net = jax.tree.map(lambda leaf: 3.0 * leaf if eqx.is_inexact_array(leaf) else leaf, net)
    batch = training.batch_of(samples)
    predicted = eqx.filter_jit(training.predict)
    carried = eqx.filter_jit(
        lambda layers, wi, wo: evaluate_second(second_lobe(layers, {media: net}), wi, wo, "all", False)
    )
    for n in range(0, len(samples.values), data.SHARD):
        numbers = jax.tree.map(lambda part, n=n: jnp.asarray(part[n]), batch.media)
        found = predicted(net, numbers, numbers.albedo, numbers.f0, batch.wi[n], batch.wo[n])
        kinds = tuple(data.KINDS[k] for k in samples.layers.kind[n])
        given = {name: jnp.asarray(array[n], jnp.float32) for name, array in vars(samples.layers).items()}
        stack = data.stack_of(kinds, True, given)
        for row, side in enumerate(training.sides_of(media)):
            wi = lj.directions.split(jnp.broadcast_to(batch.wi[n, row][:, None], batch.wo[n, row].shape))
            wo = lj.directions.split(jnp.asarray(batch.wo[n, row]))
            (second,) = carried(stack.layers, wi, wo)
            scale = np.abs(np.asarray(second)).max()
            np.testing.assert_allclose(found[row], second, rtol=2e-3, atol=1e-4 * scale, err_msg=f"{kinds} {side}")
            first = lj.evaluate(stack, batch.wi[n, row][:, None], batch.wo[n, row], lj.SingleScattering())[..., 0]
            np.testing.assert_allclose(batch.first[n, row], first, rtol=2e-3, atol=1e-4 * np.abs(first).max())


def test_samples_lie_where_they_should():
    samples = drawn(2, shards=2)
    np.testing.assert_allclose(np.linalg.norm(samples.wi, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(samples.layers.axis, axis=-1), 1.0)
    assert (samples.wi[:, 0, :, 2] > 0).all()
    assert (samples.wi[:, 1, :, 2] < 0).all()
    assert (np.sign(samples.wo[..., 2]) == np.array([1, -1, -1])[:, None, None]).all()
    # outgoing directions go by their cosine: pi times the mean of a BSDF is its albedo
    np.testing.assert_allclose(np.abs(samples.wo[..., 2]).mean(), 2 / 3, atol=5e-3)


@pytest.mark.slow
def test_a_shard_is_made_once_and_always_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "SHARD", 2)
    monkeypatch.setattr(data, "TILTED", 0.0)  # Fourier modes: quick
    assert list(data.make(tmp_path, 4, 1, "test", 7)) == [2, 4]
    files = sorted(tmp_path.iterdir())
    stamps = [path.stat().st_mtime_ns for path in files]
    before = data.load(tmp_path, 4, 1, "test", 7)
    files[1].unlink()
    list(data.make(tmp_path, 4, 1, "test", 7))
    assert files[0].stat().st_mtime_ns == stamps[0]
    again = data.load(tmp_path, 4, 1, "test", 7)
    np.testing.assert_array_equal(before.values, again.values)
    with pytest.raises(FileNotFoundError):  # of another seed
        data.load(tmp_path, 4, 1, "test", 8)
    stack = data.stack_of(
        (data.KINDS[again.layers.kind[3, 0]],), False, {k: jnp.asarray(v[3]) for k, v in vars(again.layers).items()}
    )
    solver = lj.AddingDoubling(nodes=32, modes=48, orders="multiple")
    truth = lj.evaluate(stack, again.wi[3, 0][:, None], again.wo[3, 2], solver)[..., 0]
    np.testing.assert_allclose(again.values[3, 2], truth, rtol=1e-3, atol=1e-5 * np.max(truth))


@pytest.mark.slow
def test_an_interrupted_training_ends_as_if_it_had_not_been(tmp_path):
    samples = drawn(1, shards=1)
    lines: list[str] = []
    schedule = Schedule(epochs=4, batch=8, checkpoints=2)
    state = tmp_path / "state.eqx"
    whole, curve = training.train(1, samples, 3, schedule, state, lines.append)
    assert len(lines) == 2
    state.unlink()

    class Interrupted(Exception):
        pass

    def interrupt(line):
        raise Interrupted

    with pytest.raises(Interrupted):
        training.train(1, samples, 3, Schedule(epochs=4, batch=8, checkpoints=1), state, interrupt)
    assert not state.exists()  # it was reported before it was written: nothing is half there
    steps = iter([False, True])

    def later(line):
        if next(steps):
            raise Interrupted

    with pytest.raises(Interrupted):
        training.train(1, samples, 3, Schedule(epochs=4, batch=8, checkpoints=1), state, later)
    again, same = training.train(1, samples, 3, schedule, state, lines.append)
    np.testing.assert_array_equal(curve, same)
    assert eqx.tree_equal(whole, again)


def test_networks_are_packed_and_unpacked():
    net = network(2, jax.random.key(1))
    again = unpack({f"2-{name}": part for name, part in pack(net).items()}, "2", functools.partial(network, 2))
    for mine, other in zip(net.layers, again.layers, strict=True):
        np.testing.assert_allclose(mine.weight, other.weight, rtol=1e-6)
        np.testing.assert_allclose(mine.bias, other.bias, rtol=1e-6)


@pytest.mark.slow
def test_energies_are_balanced_once_and_always_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(energy_correction, "SHARD", 2)
    monkeypatch.setattr(energy_correction, "RULE", energy_correction.Rule(nodes=4, cosines=3, azimuths=4, rounds=4))
    nets = networks()
    assert list(energy_correction.make(tmp_path, 4, 1, nets, 7)) == [2, 4]
    files = sorted(tmp_path.iterdir())
    stamps = [path.stat().st_mtime_ns for path in files]
    before = energy_correction.load(tmp_path, 4, 1, 7)
    files[1].unlink()
    list(energy_correction.make(tmp_path, 4, 1, nets, 7))
    assert files[0].stat().st_mtime_ns == stamps[0]
    again = energy_correction.load(tmp_path, 4, 1, 7)
    for one, other in zip(jax.tree.leaves(before), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.log.shape == (4, 3 * 4)
    # log c is what coefficients of these very terms make of the directions; what they miss is told by energies
    net, curve = energy_correction.train(
        1, again, 3, Schedule(epochs=150, batch=4, checkpoints=150), None, lambda line: None
    )
    assert np.max(np.abs(energy_correction.errors(net, again))) < 0.2 * np.max(np.abs(again.energy * again.log))
    assert curve[-1] < curve[0]


def test_what_is_learned_from_is_never_tested_with(monkeypatch):
    """Materials of one number, seed and count of media are drawn from streams of their own, whatever they are for."""
    streams = []

    def stop(random, *_):
        streams.append(random.bit_generator.state["state"]["state"])
        raise InterruptedError

    monkeypatch.setattr(data, "draw_layers", stop)
    monkeypatch.setattr(energy_correction, "draw_layers", stop)
    for number in range(2):
        for drawn in (
            lambda number: data.shard(number, 1, "train", 7),
            lambda number: data.shard(number, 1, "test", 7),
            lambda number: energy_correction.shard(number, 1, {}, 7),
        ):
            with pytest.raises(InterruptedError):
                drawn(number)
    assert len(set(streams)) == 6


@pytest.mark.slow
def test_a_short_run_makes_a_table_like_the_one_that_ships(tmp_path):
    """Data and training from end to end. Errors fall as more is learned from: 64 materials give 10 to 40 %."""
    lines: list[str] = []
    short, shipped = spongecake.make(True, tmp_path, lines.append), load("spongecake")
    assert short.keys() == shipped.keys()
    for media in (1, 2):
        assert short[f"{media}-curve"][-1] < short[f"{media}-curve"][0]
        assert shipped[f"{media}-error"][0, 0] < short[f"{media}-error"][0, 0] < 0.5
        assert short[f"{media}-bend-curve"][-1] < short[f"{media}-bend-curve"][0]
        assert shipped[f"{media}-bend-error"][1] < short[f"{media}-bend-error"][1] < 0.5
    again = spongecake.make(True, tmp_path, lines.append)
    for name, value in short.items():
        np.testing.assert_array_equal(value, again[name])
