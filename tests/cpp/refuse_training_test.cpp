// What the trainers' functions refuse, and what their messages say.
#include "dsmoe/training/adam.h"
#include "dsmoe/training/gather.h"
#include "dsmoe/training/gaussians.h"
#include "dsmoe/training/image_loss.h"
#include "dsmoe/training/neighbors.h"
#include "refusal.h"

namespace dsmoe {
namespace {

float numbers[12] = {};
double sums[1] = {};
int32_t marks[1] = {};
AdamRates<float> rates[1] = {};
const int32_t radii[1] = {1};
const int64_t row = 0;

std::string null(const std::string& name, const char* what) {
  return name + " is null; it must point to an array " + what;
}

template <class Arguments> struct Case {
  void (*spoil)(Arguments&);
  std::string problem;
};

// Every case makes one thing wrong of arguments that are right.
template <class Arguments, class Call>
void expect_refusals(const std::string& function, const Arguments& good, Call call,
                     const std::vector<Case<Arguments>>& cases) {
  EXPECT_NO_THROW(call(good));
  for (const auto& c : cases) {
    Arguments bad = good;
    c.spoil(bad);
    expect_refusal([&] { call(bad); }, function + ": " + c.problem);
  }
}

TEST(RefuseTraining, Adam) {
  const AdamTensor<float> good = {numbers, numbers, numbers, numbers, 12, 4, {}};
  expect_refusals("cpu::adam", good,
                  [&](const auto& second) {
                    cpu::adam<float>({good, second}, {adam_constants<float>(), nullptr}, 1);
                  },
                  {{[](auto& t) { t.parameter = nullptr; }, null("tensors[1].parameter", "of 12 numbers")},
                   {[](auto& t) { t.gradient = nullptr; }, null("tensors[1].gradient", "of 12 numbers")},
                   {[](auto& t) { t.moment = nullptr; }, null("tensors[1].moment", "of 12 numbers")},
                   {[](auto& t) { t.square = nullptr; }, null("tensors[1].square", "of 12 numbers")},
                   {[](auto& t) { t.row_size = 5; }, "tensors[1].row_size is 5; it must be 1 or more and divide 12"},
                   {[](auto& t) { t.row_size = 0; }, "tensors[1].row_size is 0; it must be 1 or more and divide 12"}});
  EXPECT_NO_THROW(cpu::adam<float>({{nullptr, nullptr, nullptr, nullptr, 0, 4, {}}}, {}, 1));  // nothing to step
}

TEST(RefuseTraining, GaussianAdam) {
  GaussianAdam<float> good = {};
  good.num_gaussians = 1, good.radii = radii;
  // Without an activation no value is read.
  for (auto& t : good.tensors) t = {numbers, nullptr, numbers, numbers, numbers, 3, Activation::kNone, {}};
  expect_refusals(
      "cpu::step_gaussians", good, [](const auto& adam) { cpu::step_gaussians(adam, 1); },
      {{[](auto& a) { a.tensors[2].activation = Activation::kExp; }, null("tensors[2].value", "of 3 numbers")},
       {[](auto& a) { a.tensors[0].raw = nullptr; }, null("tensors[0].raw", "of 3 numbers")},
       {[](auto& a) { a.tensors[3].dL_dvalue = nullptr; }, null("tensors[3].dL_dvalue", "of 3 numbers")},
       {[](auto& a) { a.tensors[1].moment = nullptr; }, null("tensors[1].moment", "of 3 numbers")},
       {[](auto& a) { a.tensors[1].square = nullptr; }, null("tensors[1].square", "of 3 numbers")},
       {[](auto& a) { a.radii = nullptr; }, null("radii", "[N]")}});
}

TEST(RefuseTraining, LazyAdam) {
  const LazyAdam<float> adam = {{{numbers, numbers, numbers, numbers, 3}}, 1, 1, marks, radii, rates, 1, {}};
  expect_refusals("cpu::catch_up", adam, [](const auto& a) { cpu::catch_up(a, 1); },
                  {{[](auto& a) { a.rates = nullptr; }, null("rates", "[steps, num_tensors]")},
                   {[](auto& a) { a.marks = nullptr; }, null("marks", "[N]")},
                   {[](auto& a) { a.tensors[0].gradient = nullptr; }, null("tensors[0].gradient", "of 3 numbers")},
                   {[](auto& a) { a.tensors[0].parameter = nullptr; }, null("tensors[0].parameter", "of 3 numbers")},
                   {[](auto& a) { a.tensors[0].moment = nullptr; }, null("tensors[0].moment", "of 3 numbers")},
                   {[](auto& a) { a.tensors[0].square = nullptr; }, null("tensors[0].square", "of 3 numbers")},
                   {[](auto& a) { a.num_tensors = 5; }, "num_tensors is 5; it must be 0 to 4"},
                   {[](auto& a) { a.num_tensors = -1; }, "num_tensors is -1; it must be 0 to 4"}});
  const LazyAdamStep<float> step = {1, marks, radii, rates, {}, 1, 0, nullptr, nullptr};
  expect_refusals("cpu::note_step", step, [](const auto& s) { cpu::note_step(s); },
                  {{[](auto& s) { s.marks = nullptr; }, null("marks", "[N]")},
                   {[](auto& s) { s.radii = nullptr; }, null("radii", "[N]")},
                   {[](auto& s) { s.rates = nullptr; }, null("rates", "[steps + 1, num_tensors]")}});
}

TEST(RefuseTraining, GatherAndNeighbours) {
  float to[3];
  const auto gather = [](const float* from, float* target, const int64_t* rows) {
    cpu::gather_rows<float>({{from, target, 3}}, {rows, 1}, 1);
  };
  EXPECT_NO_THROW(gather(numbers, to, &row));
  expect_refusal([&] { gather(nullptr, to, &row); }, "cpu::gather_rows: tensors[0].from is null; it must have rows");
  expect_refusal([&] { gather(numbers, nullptr, &row); },
                 "cpu::gather_rows: tensors[0].to is null; it must point to an array of 3 numbers");
  expect_refusal([&] { gather(numbers, to, nullptr); },
                 "cpu::gather_rows: rows is null; it must point to an array [count]");
  expect_refusal([&] { cpu::mean_squared_distances<float>(nullptr, 4, to, 1); },
                 "cpu::mean_squared_distances: points is null; it must point to an array [N, 3]");
  expect_refusal([&] { cpu::mean_squared_distances<float>(numbers, 4, nullptr, 1); },
                 "cpu::mean_squared_distances: result is null; it must point to an array [N]");
}

TEST(RefuseTraining, ImageLoss) {
  float gradient[12], derivatives[36], value[1];
  const ImageLoss<float> good = {numbers, numbers, nullptr, 1, 3, 4, 0, 1, 0, 0, 0, value, gradient, derivatives, sums};
  expect_refusals("cpu::image_loss", good, [](const auto& loss) { cpu::image_loss(loss, 1); },
                  {{[](auto& l) { l.image = nullptr; }, null("image", "[planes, height, width]")},
                   {[](auto& l) { l.target = nullptr; },
                    "target and target_bytes are null; one must point to an array [planes, height, width]"},
                   {[](auto& l) { l.loss = nullptr; }, null("loss", "[1]")},
                   {[](auto& l) { l.sums = nullptr; }, null("sums", "[num_image_loss_sums(...)]")},
                   {[](auto& l) { l.derivatives = nullptr; },
                    null("derivatives", "[3, planes, height, width], as a gradient is wanted")}});
}

}  // namespace
}  // namespace dsmoe
