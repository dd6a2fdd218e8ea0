from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_etdmpc import functional
from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel

O, A, L = 5, 2, 16  # noqa: E741


@pytest.mark.parametrize(("latent_dim", "nearest"), [(500, 496), (510, 512), (3, 8), (9, 8)])
def test_a_latent_size_that_simnorm_cannot_split_is_refused_with_the_nearest_multiple(latent_dim, nearest):
    with pytest.raises(ValueError) as error:
        WorldModel(O, A, latent_dim=latent_dim)
    assert str(error.value) == (
        f"latent_dim must be a multiple of simnorm_dim=8, got {latent_dim}; the nearest is {nearest}."
    )


@pytest.mark.parametrize("size", [0, -3])
@pytest.mark.parametrize(
    "name",
    [
        "observation_dim",
        "action_dim",
        "latent_dim",
        "mlp_dim",
        "encoder_dim",
        "encoder_layers",
        "num_dynamics",
        "num_values",
        "simnorm_dim",
    ],
)
def test_a_size_below_one_is_refused_by_name(name, size):
    with pytest.raises(ValueError, match=rf"^{name} must be at least 1, got {size}\.$"):
        WorldModel(**{"observation_dim": O, "action_dim": A, name: size})


@pytest.mark.parametrize("name", ["mlp_dim", "encoder_dim", "simnorm_dim"])
def test_a_size_that_would_make_a_network_constant_is_refused(name):
    with pytest.raises(ValueError, match=rf"^{name} must be at least 2, got 1: what is normalised over one number is"):
        WorldModel(O, A, **{name: 1})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_bins": 1}, r"num_bins must be at least 2, got 1\."),
        ({"bin_min": 3.0, "bin_max": 3.0}, r"bin_min must be below bin_max=3\.0, got 3\.0\."),
        ({"bin_min": 10.5}, r"bin_min must be below bin_max=10\.0, got 10\.5\."),
        ({"bin_max": 80.5}, r"bin_max must be in \[-80, 80\], where single precision holds symexp of it, got 80\.5\."),
        ({"bin_min": -80.5}, r"bin_min must be in \[-80, 80\], .*, got -80\.5\."),
        ({"log_std_max": 40.5}, r"log_std_max must be in \[-40, 40\], where exp of it and its .*, got 40\.5\."),
        ({"log_std_min": -40.5}, r"log_std_min must be in \[-40, 40\], .*, got -40\.5\."),
        ({"log_std_min": 1.0}, r"log_std_min must be below log_std_max=1\.0, got 1\.0\."),
        ({"log_std_max": -4.0}, r"log_std_min must be below log_std_max=-4\.0, got -3\.0\."),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), got 1\.0\."),
        ({"dropout": -0.1}, r"dropout must be in \[0, 1\), got -0\.1\."),
    ],
    ids=str,
)
def test_bins_bounds_and_rates_out_of_range_are_refused(options, message, build):
    with pytest.raises(ValueError, match=rf"^{message}$"):
        build(**options)


def test_an_unknown_activation_is_refused_with_the_choices(build):
    with pytest.raises(ValueError, match=r"^activation must be one of mish, silu, relu, got 'gelu'\.$"):
        build(activation="gelu")


@pytest.mark.parametrize("kind", [WorldModel, ActionValueWorldModel])
def test_the_activation_reaches_every_network(kind):
    options = {"latent_dim": L, "mlp_dim": 16, "termination": True}
    mish, relu = kind(O, A, **options), kind(O, A, activation="relu", **options)
    relu.load_state_dict(mish.state_dict())
    networks = [name for name, _ in mish.named_children()]
    assert networks == ["encoder", "dynamics", "reward_head", "value_head", "policy", "termination_head"]
    for name in networks:
        activations = [{layer.activation for layer in getattr(m, name).hidden} for m in (mish, relu)]
        assert activations == [{functional.mish}, {nn.functional.relu}], name


def test_an_encoder_that_is_empty_is_still_the_encoder(build):
    model = build(encoder=nn.Sequential())
    latent = torch.rand(5, model.latent_dim)
    assert torch.equal(model.encode(latent), latent)


@pytest.mark.parametrize(
    "layer",
    [
        nn.Dropout(0.1),
        nn.BatchNorm1d(8),
        nn.RReLU(),
        nn.MultiheadAttention(8, 2, dropout=0.1),
        nn.LSTM(8, 8, num_layers=2, dropout=0.1),
    ],
    ids=lambda layer: type(layer).__name__,
)
def test_an_encoder_that_acts_differently_in_training_is_refused_unless_it_is_frozen(layer):
    encoder = nn.Sequential(nn.Linear(3, 8), layer.train())
    with pytest.raises(ValueError, match=rf"the encoder's {type(layer).__name__} '1' acts differently in training"):
        WorldModel(None, 2, latent_dim=8, mlp_dim=8, encoder=encoder)
    WorldModel(None, 2, latent_dim=8, mlp_dim=8, encoder=encoder.eval())
    same = nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.0), nn.LSTM(8, 8), nn.LayerNorm(8), nn.GroupNorm(2, 8))
    WorldModel(None, 2, latent_dim=8, mlp_dim=8, encoder=same)


@pytest.mark.parametrize("norm", [nn.utils.parametrizations.spectral_norm, nn.utils.spectral_norm])
def test_a_spectral_norm_is_estimated_anew_in_every_call_unless_it_is_frozen(norm):
    encoder = norm(nn.Linear(3, 8))
    with pytest.raises(ValueError, match=r"acts differently in training, and planning would use it so; .* \.eval\(\)"):
        WorldModel(None, 2, latent_dim=8, mlp_dim=8, encoder=encoder)
    WorldModel(None, 2, latent_dim=8, mlp_dim=8, encoder=encoder.eval())


def test_an_observation_of_another_size_is_named():
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16)
    with pytest.raises(
        ValueError, match=r"^observations must be of shape \[\.\.\., 3\], got \[5, 4\]; build the world"
    ):
        model.encode(torch.zeros(5, 4))


def test_a_batch_norm_without_running_statistics_is_the_same_in_training_and_is_taken():
    encoder = nn.Sequential(nn.Linear(3, 8), nn.BatchNorm1d(8, track_running_stats=False))
    WorldModel(None, 2, latent_dim=8, mlp_dim=8, encoder=encoder).train()
    assert encoder[1].training
