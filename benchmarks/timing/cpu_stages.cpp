// The CPU backend's stages under Google Benchmark: projection, tile lists (which sorts), blending and its backward pass
// in each mode, and the projection's backward pass. Built as dsmoe_benchmarks if the library is found.
//
//     build/cpp/tests/cpp/dsmoe_benchmarks --benchmark_filter='Blend.*/smoe/' --benchmark_repetitions=5
//
// Numbers behind a name: Gaussians, threads. Items are Gaussians.
#include <benchmark/benchmark.h>

#include <string>

#include "test_scene.h"

namespace dsmoe {
namespace {

constexpr int kWidth = 640, kHeight = 360;

// Gaussians of a few pixels, as in a trained scene; in `smoe` with a background gate.
Scene<float> benchmark_scene(const benchmark::State& state, BlendMode mode) {
  Scene<double> scene = make_scene(1, static_cast<int>(state.range(0)), kWidth, kHeight);
  scene.config.scale_modifier = 0.15;
  scene.config.num_threads = static_cast<int>(state.range(1));
  scene.config.blend.mode = mode;
  return convert<float>(scene);
}

void finish(benchmark::State& state, size_t num_instances) {
  state.SetItemsProcessed(state.iterations() * state.range(0));
  state.counters["instances"] = static_cast<double>(num_instances);
}

void project(benchmark::State& state) {
  const Scene<float> scene = benchmark_scene(state, BlendMode::kAlpha);
  Rendering<float> rendering(scene);
  const auto frame = frame_of(scene, rendering);
  int64_t num_instances = 0;
  for (auto _ : state) num_instances = cpu::project(frame);
  finish(state, num_instances);
}

void tile_lists(benchmark::State& state) {
  const Scene<float> scene = benchmark_scene(state, BlendMode::kAlpha);
  Rendering<float> rendering = project_and_bin(scene);
  const auto frame = frame_of(scene, rendering);
  for (auto _ : state) cpu::bin(frame);
  finish(state, rendering.instances.size());
}

void blend(benchmark::State& state, BlendMode mode) {
  const Scene<float> scene = benchmark_scene(state, mode);
  Rendering<float> rendering = project_and_bin(scene);
  const auto frame = frame_of(scene, rendering);
  for (auto _ : state) cpu::blend(frame);
  finish(state, rendering.instances.size());
}

// Both stages of the backward pass, each in a counter of its own: seconds a pass.
void backward(benchmark::State& state, BlendMode mode) {
  const Scene<float> scene = benchmark_scene(state, mode);
  Rendering<float> rendering = render(scene);
  const ImageWeights<float> weights(scene, 2);
  SceneGradient<float> gradient(scene);
  const auto frame = frame_of(scene, rendering);
  StageTimes times;
  for (auto _ : state) cpu::backward(frame, {weights.gradients(), gradient.gradients()}, &times);
  finish(state, rendering.instances.size());
  state.counters["blend_s"] = benchmark::Counter(times.blend_backward, benchmark::Counter::kAvgIterations);
  state.counters["project_s"] = benchmark::Counter(times.project_backward, benchmark::Counter::kAvgIterations);
}

void sizes(benchmark::internal::Benchmark* benchmark) {
  benchmark->Unit(benchmark::kMillisecond)->UseRealTime()->ArgNames({"gaussians", "threads"});
  for (const int64_t threads : {1, 2}) benchmark->Args({20'000, threads});
}

const bool registered = [] {
  benchmark::RegisterBenchmark("Project", project)->Apply(sizes);
  benchmark::RegisterBenchmark("TileLists", tile_lists)->Apply(sizes);
  BlendModes::for_each([](auto mode) {
    const std::string name = Blend<decltype(mode)::value>::kName;
    benchmark::RegisterBenchmark(("Blend/" + name).c_str(), blend, mode())->Apply(sizes);
    benchmark::RegisterBenchmark(("Backward/" + name).c_str(), backward, mode())->Apply(sizes);
  });
  return true;
}();

}  // namespace
}  // namespace dsmoe
