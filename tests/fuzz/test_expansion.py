"""The shortest records that a format allows take no more memory than the documentation says."""

import tracemalloc

import pytest
import torch
from fuzz.expansion import EXPANDING, read_quietly, target_of

from reference_trainer.scenes.images import read_image

SIZE = 50_000


@pytest.mark.slow
@pytest.mark.parametrize(("name", "what"), EXPANDING)
def test_memory_is_in_proportion_to_the_file(name, what, tmp_path):
    target = target_of(name)
    target.write(tmp_path)
    read_quietly(target, tmp_path)  # imports
    (tmp_path / target.file).write_bytes(EXPANDING[name, what](SIZE))
    fixed = 100_000 if name != "checkpoint" else target.memory
    bound, peaks = target.expansion * (tmp_path / target.file).stat().st_size + fixed, []
    while len(peaks) < 3:  # the least counts: what a thread that another test has left allocates is no part of reading
        tracemalloc.start()
        read_quietly(target, tmp_path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        if peaks[-1] < bound:
            return
    pytest.fail(f"peaks {peaks}, all of {bound} and more")


def test_a_picture_is_converted_in_bands(tmp_path):
    """Beside the decoded pixels, which Pillow holds outside of Python, and the result, which torch does."""
    from PIL import Image

    pixels = torch.randint(0, 256, (1000, 1000, 4), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    Image.fromarray(pixels.numpy()).save(tmp_path / "a.png", compress_level=0)
    read_image(tmp_path / "a.png")
    tracemalloc.start()
    image, alpha = read_image(tmp_path / "a.png")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert torch.equal((torch.cat([image, alpha[None]]) * 255).round().to(torch.uint8), pixels.permute(2, 0, 1))
    assert peak < 2_000_000  # of 1,000,000 pixels; 8,000,000 and more where all are converted at once
