"""Configuration: TOML in and out, refusals by name, immutability."""

import dataclasses
import inspect
import tomllib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from delo_jax.config import (
    AttentionConfig,
    DeloConfig,
    EncoderConfig,
    EvidenceConfig,
    FineConfig,
    MatchingConfig,
    PoseConfig,
    PreprocessConfig,
    StatusConfig,
    TrainConfig,
    from_dict,
    load,
    to_toml,
)
from delo_jax.errors import ConfigError
from delo_jax.train.presets import PRESETS

PARTS = [PreprocessConfig, EncoderConfig, AttentionConfig, MatchingConfig, PoseConfig, FineConfig, EvidenceConfig, StatusConfig]
ALL = [*PARTS, DeloConfig, TrainConfig]
CHANGED = TrainConfig(
    model=DeloConfig(name="it's", matching=MatchingConfig(mass=1.0), evidence=EvidenceConfig(rotation_scale_rad=1e-30)),
    seed=3,
    learning_rate=1e22,
)
RAW = {"preprocess": PreprocessConfig(sampling="raw", max_points=64, num_keypoints=64), "encoder": EncoderConfig(kind="dgcnn")}


@pytest.mark.parametrize("config", [*(cls() for cls in ALL), CHANGED, *PRESETS.values()], ids=lambda config: type(config).__name__)
def test_toml_says_what_the_config_holds(config, tmp_path):
    """Oracle: tomllib against dataclasses.asdict; `load` then gives an equal config."""
    text = to_toml(config)
    assert tomllib.loads(text) == dataclasses.asdict(config)
    (tmp_path / "config.toml").write_text(text, encoding="utf-8")
    assert load(type(config), tmp_path / "config.toml") == config


@example('\x7f\n"\\')
@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_any_name_survives(name):
    """Oracle: tomllib; quotes, backslashes, line breaks and control characters included."""
    assert tomllib.loads(to_toml(DeloConfig(name=name)))["name"] == name


def test_missing_keys_keep_their_defaults(tmp_path):
    """Oracle: dataclasses.replace."""
    (tmp_path / "config.toml").write_text("seed = 7\n[model.matching]\nmass = 1\n")
    expected = dataclasses.replace(TrainConfig(), seed=7, model=DeloConfig(matching=MatchingConfig(mass=1.0)))
    found = load(TrainConfig, tmp_path / "config.toml")
    assert found == expected
    assert type(found.model.matching.mass) is float


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"matching": {"mas": 0.3}}, r"config\.matching: expected one of plan, .*, got 'mas'; did you mean 'mass'\?"),
        ({"coarse": {"mass": 0.3}}, r"config: expected one of name, .*, got 'coarse'"),
        ({"preproces": {}}, r"config: expected one of name, .*, got 'preproces'; did you mean 'preprocess'\?"),
        ({"fine": {"zzz": 1}}, r"config\.fine: expected one of [^;]*, got 'zzz'$"),
    ],
)
def test_unknown_key_is_named_with_its_neighbour(table, message):
    """Oracle: the sentence, written by hand."""
    with pytest.raises(ConfigError, match=message):
        from_dict(DeloConfig, table)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"num_steps": "many"}, "config.num_steps: expected a value of type int, got 'many'"),
        ({"num_steps": 1.5}, "config.num_steps: expected a value of type int, got 1.5"),
        ({"num_steps": True}, "config.num_steps: expected a value of type int, got True"),
        ({"learning_rate": False}, "config.learning_rate: expected a value of type float, got False"),
        ({"learning_rate": [1.0]}, "config.learning_rate: expected a value of type float"),
        ({"model": 3}, "config.model: expected a table, got 3"),
        ({"model": {"name": 3}}, "config.model.name: expected a value of type str, got 3"),
        ({"seed": {"a": 1}}, "config.seed: expected a value of type int"),
    ],
)
def test_wrong_type_is_refused(table, message):
    """Oracle: the sentence, written by hand; an integer where a float is meant is taken, nothing else is."""
    with pytest.raises(ConfigError, match=message):
        from_dict(TrainConfig, table)


@pytest.mark.parametrize(
    ("cls", "values"),
    [
        (PreprocessConfig, {"min_range_m": -1.0}),
        (PreprocessConfig, {"min_range_m": 80.0}),
        (PreprocessConfig, {"max_range_m": float("nan")}),
        (PreprocessConfig, {"voxel_m": 0.0}),
        (PreprocessConfig, {"voxel_m": 1.0}),
        (PreprocessConfig, {"max_raw_points": 0}),
        (PreprocessConfig, {"num_neighbors": 4}),
        (PreprocessConfig, {"keypoint_voxel_m": 0.0}),
        (PreprocessConfig, {"keypoint_range_m": -1.0}),
        (PreprocessConfig, {"ground_share": 0.0}),
        (PreprocessConfig, {"num_keypoints": 0}),
        (PreprocessConfig, {"num_keypoints": 4000}),
        (PreprocessConfig, {"sampling": "even"}),
        (PreprocessConfig, {"sampling": "raw"}),  # 384 key points of 3072 points
        (EncoderConfig, {"kind": "pointnet"}),
        (EncoderConfig, {"edges": "both"}),
        (EncoderConfig, {"edges": "absolute"}),  # edge_conv has relative ones only
        (EncoderConfig, {"num_neighbors": 0}),
        (EncoderConfig, {"edge_scale_m": 0.0}),
        (EncoderConfig, {"position_scale_m": float("nan")}),
        (EncoderConfig, {"width": 0}),
        (EncoderConfig, {"embedding_dim": 0}),
        (AttentionConfig, {"num_heads": -1}),
        (AttentionConfig, {"hidden": 0}),
        (MatchingConfig, {"plan": "sinkhorn"}),
        (MatchingConfig, {"scores": "angle"}),
        (MatchingConfig, {"mass": 0.0}),
        (MatchingConfig, {"mass": 1.01}),
        (MatchingConfig, {"num_iters": 0}),
        (MatchingConfig, {"epsilon": 0.0}),
        (MatchingConfig, {"epsilon": 0.01, "learn_epsilon": True}),
        (MatchingConfig, {"plan": "softmax", "predict_mass": True}),  # which has no mass
        (MatchingConfig, {"num_candidates": 0}),
        (MatchingConfig, {"marginal_weight": -1.0}),
        (PoseConfig, {"solver": "ransac"}),
        (PoseConfig, {"consistency_m": float("nan")}),
        (PoseConfig, {"num_rounds": 0}),
        (FineConfig, {"num_points": 15}),
        (FineConfig, {"num_iters": 1}),
        (EvidenceConfig, {"head": "mlp"}),
        (EvidenceConfig, {"embedding": "decoder"}),
        (EvidenceConfig, {"width": 0}),
        (EvidenceConfig, {"rotation_scale_rad": 0.0}),
        (EvidenceConfig, {"translation_scale_m": -1.0}),
        (StatusConfig, {"ok_confidence": 1.5}),
        (StatusConfig, {"rejected_confidence": 0.9}),
        (DeloConfig, {"encoder": EncoderConfig(num_neighbors=400)}),
        (DeloConfig, {"attention": AttentionConfig(num_heads=3)}),  # of 64 channels
        (DeloConfig, {"attention": AttentionConfig(num_heads=4)}),  # cosines of descriptors that are not unit
        (DeloConfig, {"encoder": EncoderConfig(kind="dgcnn")}),
        (DeloConfig, RAW | {"encoder": EncoderConfig(), "fine": FineConfig(num_iters=0), "evidence": EvidenceConfig(head="none")}),
        (DeloConfig, RAW | {"evidence": EvidenceConfig(head="none")}),  # a fine stage without normals
        (DeloConfig, RAW | {"fine": FineConfig(num_iters=0)}),  # statistics of no fine stage
        (TrainConfig, {"num_frames": 1}),
        (TrainConfig, {"num_scenes": 0}),
        (TrainConfig, {"num_validation_scenes": 0}),
        (TrainConfig, {"batch_size": 0}),
        (TrainConfig, {"model": PRESETS["paper"].model, "fine_weight": 0.0, "batch_size": 1}),  # batch norm of one
        (TrainConfig, {"num_points": 0}),
        (TrainConfig, {"learning_rate": 0.0}),
        (TrainConfig, {"learning_rate": float("nan")}),
        (TrainConfig, {"seed": -1}),
        (TrainConfig, {"num_steps": 9}),
        (TrainConfig, {"num_steps": -10}),
        (TrainConfig, {"num_evidence_steps": 1}),
        (TrainConfig, {"matching_weight": -1.0}),
        (TrainConfig, {"fine_weight": -1.0}),
        (TrainConfig, {"odometry_weight": -1.0}),
        (TrainConfig, {"aux_weight": -1.0}),
        (TrainConfig, {"evidence_weight": float("nan")}),
        (TrainConfig, {"rotation_regulariser": -1.0}),
        (TrainConfig, {"translation_regulariser": -1.0}),
        (TrainConfig, {"schedule": "linear"}),
        (TrainConfig, {"schedule": "steps"}),  # of how many epochs
        (TrainConfig, {"num_epochs": -1}),
        (TrainConfig, {"max_gap": 0}),
        (TrainConfig, {"clip_norm": -1.0}),
        (TrainConfig, {"warmup_steps": -1}),
        (TrainConfig, {"pose_loss": "l2"}),
        (TrainConfig, {"matching_loss": "costs"}),
        (TrainConfig, {"model": DeloConfig(fine=FineConfig(num_iters=0), evidence=EvidenceConfig(head="none")), "evidence_weight": 0.0}),
        (TrainConfig, {"model": DeloConfig(evidence=EvidenceConfig(head="none"))}),
        (TrainConfig, {"num_iters": 5}),
        (TrainConfig, {"validate_every": 0}),
    ],
)
def test_value_out_of_range_is_refused_by_name(cls, values):
    """Oracle: the documented ranges; the message names the field that was given, or the one it collides with."""
    with pytest.raises(ConfigError, match=r"^[a-z_.]+: expected .*, got "):
        cls(**values)


@pytest.mark.parametrize("values", [{"num_steps": 0}, {"num_steps": 10}, {"num_evidence_steps": 0}, {"evidence_weight": 0.0}, {"seed": 0}])
def test_value_at_the_edge_is_taken(values):
    """Oracle: the documented ranges."""
    assert dataclasses.asdict(TrainConfig(**values)).items() >= values.items()


def test_unreadable_files_are_one_sentence(tmp_path):
    """Oracle: the file's name and what is wrong with it."""
    with pytest.raises(ConfigError, match="missing.toml: expected a readable TOML file, got No such file"):
        load(DeloConfig, tmp_path / "missing.toml")
    with pytest.raises(ConfigError, match="got Is a directory"):
        load(DeloConfig, tmp_path)
    for content in (b"name = ", b"\xff\xfe\x00"):
        (tmp_path / "bad.toml").write_bytes(content)
        with pytest.raises(ConfigError, match="bad.toml: expected valid TOML, got .*; mend the file"):
            load(DeloConfig, tmp_path / "bad.toml")


@pytest.mark.parametrize("cls", ALL)
def test_configs_are_values(cls):
    """Oracle: equal configs have equal hashes, and none can be changed, so that they may be static under jit."""
    assert hash(cls()) == hash(cls())
    assert cls() == cls()
    name = dataclasses.fields(cls)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(cls(), name, 1)
    with pytest.raises(TypeError):
        cls(1)


@pytest.mark.parametrize("cls", ALL)
def test_every_field_is_documented(cls):
    """Oracle: the source; one docstring under every field, from which the command line takes its help."""
    lines = [line.strip() for line in inspect.getsource(cls).splitlines()]
    for field in dataclasses.fields(cls):
        index = next(i for i, line in enumerate(lines) if line.startswith(f"{field.name}:"))
        assert lines[index + 1].startswith('"""'), field.name
