"""Streams, threads and devices: a call works on the current stream of its tensors' device, and shares no state."""
from __future__ import annotations

import threading

import pytest
import torch
from comparison import assert_same_gradients
from scenes import gradients, random_scene

from diff_smoe_rasterization import GaussianRasterizer, rasterize
from diff_smoe_rasterization.settings import BLEND_MODES, OUTPUTS


def scene_of(mode, gpu, seed=0, **options):
    return random_scene(mode, 3000, 131, 83, seed=seed, scale=0.04, degree=1, dtype=torch.float32, **options).to(gpu)


def assert_same(actual, expected):
    (rendering, gradient), (expected_rendering, expected_gradient) = actual, expected
    assert all(torch.equal(image, expected_image) for image, expected_image in zip(rendering, expected_rendering))
    assert_same_gradients(gradient, expected_gradient)


def test_two_threads_on_two_streams(mode, gpu):
    scenes = [scene_of(mode, gpu, seed) for seed in (0, 1)]
    expected = [gradients(rasterize, scene, OUTPUTS) for scene in scenes]
    results, start = [[], []], threading.Barrier(2)
    torch.cuda.synchronize()

    def work(index):
        stream = torch.cuda.Stream(gpu)
        start.wait()
        with torch.cuda.stream(stream):
            for _ in range(20):
                results[index].append(gradients(rasterize, scenes[index], OUTPUTS))
        stream.synchronize()

    threads = [threading.Thread(target=work, args=(index,)) for index in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for index in (0, 1):
        assert len(results[index]) == 20, "the thread failed; its error is above"
        for result in results[index]:
            assert_same(result, expected[index])


def test_different_modes_and_sizes_at_the_same_time(gpu):
    scenes = [random_scene(mode, 500 * (index + 1), 60 + 31 * index, 50, seed=index, degree=index % 3,
                           dtype=torch.float32).to(gpu) for index, mode in enumerate(BLEND_MODES)]
    expected = [gradients(rasterize, scene, OUTPUTS) for scene in scenes]
    torch.cuda.synchronize()
    streams = [torch.cuda.Stream(gpu) for _ in scenes]
    results = []
    for _ in range(5):
        for index, scene in enumerate(scenes):
            with torch.cuda.stream(streams[index]):
                results.append((index, gradients(rasterize, scene, OUTPUTS)))
    torch.cuda.synchronize()
    for index, result in results:
        assert_same(result, expected[index])


def test_a_call_waits_for_what_its_stream_does_first(mode, gpu):
    """The inputs are still being written when the call is made; on another stream it would read them too early."""
    scene = scene_of(mode, gpu)
    expected = gradients(rasterize, scene, OUTPUTS)
    late = scene.with_inputs(means3D=torch.full_like(scene.inputs["means3D"], 1e3))
    torch.cuda.synchronize()
    stream = torch.cuda.Stream(gpu)
    with torch.cuda.stream(stream):
        torch.cuda._sleep(200_000_000)  # about 0.1 s
        late.inputs["means3D"].copy_(scene.inputs["means3D"])
        result = gradients(rasterize, late, OUTPUTS)
    torch.cuda.synchronize()
    assert_same(result, expected)


@pytest.fixture
def second_gpu(gpu):
    if torch.cuda.device_count() < 2:
        pytest.skip("there is one GPU")
    return torch.device("cuda:1")


def test_the_device_need_not_be_the_current_one(mode, gpu, second_gpu):
    scene = scene_of(mode, gpu)
    expected = gradients(rasterize, scene, OUTPUTS)
    assert torch.cuda.current_device() == 0
    rendering, gradient = gradients(rasterize, scene.to(second_gpu), OUTPUTS)
    visible = GaussianRasterizer(scene.to(second_gpu).settings).markVisible(scene.inputs["means3D"].to(second_gpu))
    assert torch.cuda.current_device() == 0
    assert {tensor.device for tensor in [*rendering, *gradient.values(), visible]} == {second_gpu}
    actual = (tuple(image.to(gpu) for image in rendering), {name: value.to(gpu) for name, value in gradient.items()})
    assert_same(actual, expected)


def test_tensors_on_two_gpus_are_refused(gpu, second_gpu):
    scene = scene_of("smoe", gpu)
    with pytest.raises(TypeError, match="scales is on cuda:1"):
        rasterize(settings=scene.settings, **{**scene.inputs, "scales": scene.inputs["scales"].to(second_gpu)})


def test_tensors_on_the_cpu_and_a_gpu_are_refused(gpu):
    scene = scene_of("smoe", gpu)
    with pytest.raises(TypeError, match="viewmatrix is on cpu"):
        rasterize(settings=scene.settings._replace(viewmatrix=scene.settings.viewmatrix.cpu()), **scene.inputs)
