import pytest
import torch

from nerf_lightning.evaluation.lpips import LPIPS, LPIPS_HINT, load_lpips
from nerf_lightning.messages.errors import InputError

# As published in torchvision's state dicts of alexnet and vgg16.
ALEXNET = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
_VGG = {0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256)}
_VGG |= {17: (512, 256)} | dict.fromkeys((19, 21, 24, 26, 28), (512, 512))
VGG16 = {index: (*channels, 3, 3) for index, channels in _VGG.items()}


def torchvision_like(shapes):
    generator = torch.Generator().manual_seed(3)
    state = {"classifier.1.weight": torch.zeros(2, 2)}
    for index, shape in shapes.items():
        fan_in = shape[1] * shape[2] * shape[3]
        state[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5
        state[f"features.{index}.bias"] = torch.randn(shape[0], generator=generator) * 0.01
    return state


@pytest.fixture(scope="module", params=["alex", "vgg"])
def lpips(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "backbone.pth"
    torch.save(torchvision_like(ALEXNET if request.param == "alex" else VGG16), path)
    return load_lpips(str(path), request.param)


@pytest.mark.parametrize(("net", "shapes"), [("alex", ALEXNET), ("vgg", VGG16)])
def test_names_and_shapes_are_torchvisions(net, shapes):
    wanted = {name: tuple(t.shape) for name, t in torchvision_like(shapes).items() if name.startswith("features")}
    assert {name: tuple(t.shape) for name, t in LPIPS(net).state_dict().items()} == wanted


def test_distance_is_symmetric_positive_and_grows_with_noise(lpips):
    torch.manual_seed(0)
    truth, noise = torch.rand(48, 64, 3) * 0.5 + 0.25, torch.randn(48, 64, 3)
    assert lpips(truth, truth) == 0.0
    scores = [lpips.score(truth + level * noise, truth) for level in (0.01, 0.05, 0.2)]
    assert 0 < scores[0] < scores[1] < scores[2]
    assert lpips.score(truth, truth + 0.05 * noise) == pytest.approx(scores[1], rel=1e-4)


def test_distance_by_the_papers_formula(lpips):
    """A slow walk through the definition, with torchmetrics' own file of channel weights."""
    torch.manual_seed(1)
    pictures = torch.rand(2, 40, 40, 3)
    x = (pictures.movedim(-1, 1) * 2 - 1 - torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)) / torch.tensor(
        [0.458, 0.448, 0.450]
    ).view(1, 3, 1, 1)
    taps = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}[lpips.net]
    total = 0.0
    for index, layer in enumerate(lpips.features):
        x = layer(x)
        if index in taps:
            weights = getattr(lpips, f"channels{taps.index(index)}").flatten()
            assert (weights >= 0).all()
            unit = x / x.norm(dim=1, keepdim=True).clamp(min=1e-4)
            total += float(((unit[0] - unit[1]) ** 2 * weights[:, None, None]).sum(0).mean())
    assert lpips.score(*pictures) == pytest.approx(total, rel=1e-3)


def test_too_small_a_picture_has_no_score(lpips):
    smallest = {"alex": 31, "vgg": 16}[lpips.net]
    assert lpips.score(torch.rand(smallest, 64, 3), torch.rand(smallest, 64, 3)) > 0
    assert lpips.score(torch.rand(smallest - 1, 64, 3), torch.rand(smallest - 1, 64, 3)) is None
    with pytest.raises(RuntimeError):
        lpips(torch.rand(smallest - 1, 64, 3), torch.rand(smallest - 1, 64, 3))


def test_a_missing_file_says_how_to_get_it_and_a_wrong_one_is_named(tmp_path):
    with pytest.raises(InputError) as caught:
        load_lpips(str(tmp_path / "alexnet.pth"))
    assert "does not exist" in str(caught.value)
    assert LPIPS_HINT in str(caught.value)
    path = tmp_path / "weights.pth"
    wrong = torchvision_like(ALEXNET)
    wrong["features.3.weight"] = torch.zeros(1)
    cases = [
        (torch.zeros(3), "weights is a Tensor, not of the type dict"),
        ({"layer": torch.zeros(3)}, r"weights.features.\d+.weight is missing"),
        (LPIPS("alex").state_dict() | {"features.0.weight": torch.full((64, 3, 11, 11), torch.nan)}, "holds NaN"),
        (wrong, r"features.3.weight holds torch.float32 in the shape \(1,\), not .*\(192, 64, 5, 5\)"),
    ]
    for content, words in cases:
        torch.save(content, path)
        with pytest.raises(InputError, match=words):
            load_lpips(str(path))
    for junk in (b"", b"<html>404</html>", b"\x80\x02cos\nsystem\n."):
        path.write_bytes(junk)
        with pytest.raises(InputError, match=r"weights\.pth"):
            load_lpips(str(path))
