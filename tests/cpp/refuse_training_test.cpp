// What the trainers' functions refuse, and what their messages say.
#include "refuse_training.h"

#include <gtest/gtest.h>

#include <functional>
#include <stdexcept>
#include <string>
#include <vector>

#include "dsmoe/neighbors.h"

namespace dsmoe {
namespace {

void expect_refusal(const std::function<void()>& call, const std::string& message) {
  try {
    call();
    ADD_FAILURE() << "nothing was thrown; expected: " << message;
  } catch (const std::invalid_argument& error) {
    EXPECT_EQ(error.what(), message);
  }
}

float numbers[12] = {};
int32_t marks[1] = {};
AdamRates<float> rates[1] = {};
const int32_t radii[1] = {1};

TEST(RefuseTraining, AdamNamesTheTensor) {
  const AdamTensor<float> good = {numbers, numbers, numbers, numbers, 12, 4, {}};
  const auto refuses = [&](auto field, const std::string& problem) {
    AdamTensor<float> bad = good;
    field(bad);
    expect_refusal(
        [&] {
          cpu::adam<float>({good, bad}, {adam_constants<float>(), nullptr}, 1);
        },
        "cpu::adam: tensors[1]." + problem);
  };
  refuses([](auto& t) { t.parameter = nullptr; }, "parameter is null; it must point to an array of 12 numbers");
  refuses([](auto& t) { t.gradient = nullptr; }, "gradient is null; it must point to an array of 12 numbers");
  refuses([](auto& t) { t.moment = nullptr; }, "moment is null; it must point to an array of 12 numbers");
  refuses([](auto& t) { t.square = nullptr; }, "square is null; it must point to an array of 12 numbers");
  refuses([](auto& t) { t.row_size = 5; }, "row_size is 5; it must be 1 or more and divide 12");
  refuses([](auto& t) { t.row_size = 0; }, "row_size is 0; it must be 1 or more and divide 12");
  EXPECT_NO_THROW(cpu::adam<float>({{nullptr, nullptr, nullptr, nullptr, 0, 4, {}}}, {}, 1));  // nothing to step
}

TEST(RefuseTraining, GaussianAdam) {
  GaussianAdam<float> adam = {};
  adam.num_gaussians = 1, adam.radii = radii;
  for (auto& t : adam.tensors) t = {numbers, nullptr, numbers, numbers, numbers, 3, Activation::kNone, {}};
  EXPECT_NO_THROW(refuse_step_gaussians("f", adam));  // without an activation no value is read
  adam.tensors[2].activation = Activation::kExp;
  expect_refusal([&] { cpu::step_gaussians(adam, 1); },
                 "cpu::step_gaussians: tensors[2].value is null; it must point to an array of 3 numbers");
  adam.tensors[2].value = numbers, adam.radii = nullptr;
  expect_refusal([&] { cpu::step_gaussians(adam, 1); },
                 "cpu::step_gaussians: radii is null; it must point to an array [N]");
}

TEST(RefuseTraining, LazyAdam) {
  LazyAdam<float> adam = {{{numbers, numbers, numbers, numbers, 3}}, 1, 1, marks, radii, nullptr, 2, {}};
  expect_refusal([&] { cpu::catch_up(adam, 1); },
                 "cpu::catch_up: rates is null; it must point to an array [steps, num_tensors]");
  adam.tensors[0].gradient = nullptr;
  expect_refusal([&] { cpu::catch_up(adam, 1); },
                 "cpu::catch_up: tensors[0].gradient is null; it must point to an array of 3 numbers");
  adam.num_tensors = 5;
  expect_refusal([&] { cpu::catch_up(adam, 1); }, "cpu::catch_up: num_tensors is 5; it must be 0 to 4");
  LazyAdamStep<float> step = {1, nullptr, radii, rates, {}, 1, 0};
  expect_refusal([&] { cpu::note_step(step); }, "cpu::note_step: marks is null; it must point to an array [N]");
}

TEST(RefuseTraining, GatherAndNeighbours) {
  const int64_t row = 0;
  expect_refusal(
      [&] {
        cpu::gather_rows<float>({{nullptr, numbers, 3}}, {&row, 1}, 1);
      },
      "cpu::gather_rows: tensors[0].from is null; it must have rows");
  expect_refusal(
      [&] {
        cpu::gather_rows<float>({{numbers, numbers, 3}}, {nullptr, 1}, 1);
      },
      "cpu::gather_rows: rows is null; it must point to an array [count]");
  expect_refusal([&] { cpu::mean_squared_distances<float>(numbers, 4, nullptr, 1); },
                 "cpu::mean_squared_distances: result is null; it must point to an array [N]");
}

TEST(RefuseTraining, ImageLoss) {
  double sums[1];
  ImageLoss<float> loss = {numbers, numbers, nullptr, 1, 3, 4, 0, 1, 0, 0, numbers, numbers, nullptr, sums};
  expect_refusal([&] { cpu::image_loss(loss, 1); },
                 "cpu::image_loss: derivatives is null; it must point to an array [3, planes, height, width], as a "
                 "gradient is wanted");
  loss.target = nullptr;
  expect_refusal([&] { cpu::image_loss(loss, 1); },
                 "cpu::image_loss: target and target_bytes are null; one must point to an array [planes, height, "
                 "width]");
}

}  // namespace
}  // namespace dsmoe
