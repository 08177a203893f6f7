// The trainable Gaussians: raw parameters under Adam, and the density control of 3D Gaussian Splatting.
#pragma once

#include <dsmoe/params.h>
#include <dsmoe/torch_training.h>

#include "io/ply.h"
#include "scene.h"

// The recipe of 3D Gaussian Splatting (Kerbl et al. 2023), as its release runs it.
struct Recipe {
  int iterations = 30'000;
  double position_lr_init = 1.6e-4, position_lr_final = 1.6e-6;  // times the scene's extent; log-linear between
  double feature_lr = 2.5e-3, opacity_lr = 0.05, scaling_lr = 5e-3, rotation_lr = 1e-3;
  double lambda_dssim = 0.2;
  double densify_grad_threshold = 2e-4, percent_dense = 0.01;  // mean screen-space gradient; part of the extent
  int sh_degree = 3, sh_degree_interval = 1000;
  int densify_from = 500, densify_until = 15'000, densification_interval = 100, opacity_reset_interval = 3000;

  // With other iterations each milestone keeps its share.
  static Recipe of(int iterations) {
    Recipe recipe;
    for (int* milestone :
         {&recipe.sh_degree_interval, &recipe.densify_from, &recipe.densify_until, &recipe.opacity_reset_interval}) {
      *milestone = std::max<int>(1, std::lround(1.0 * *milestone * iterations / recipe.iterations));
    }
    recipe.densification_interval = std::min(100, std::max(1, recipe.densify_until / 10));
    recipe.iterations = iterations;
    return recipe;
  }
};

inline void step_and_forget_gradients(std::vector<dsmoe::AdamParameter>& parameters, double epsilon = 1e-8) {
  dsmoe::adam_step(parameters, epsilon);
  for (auto& parameter : parameters) parameter.value.mutable_grad().reset();
}

class Gaussians {
 public:
  enum Parameter { kMeans, kDc, kShs, kOpacities, kScales, kRotations, kCount };

  // Round Gaussians as wide as the distance to their neighbours.
  Gaussians(const Scene& scene, const Recipe& recipe) : recipe_(recipe), extent_(scene.extent) {
    const int64_t count = scene.points.size(0), coefficients = (recipe.sh_degree + 1) * (recipe.sh_degree + 1);
    const auto like = scene.colors.options();
    const auto log_scales = dsmoe::distCUDA2(scene.points).clamp_min(1e-7).sqrt().log().to(torch::kFloat);
    const std::vector<torch::Tensor> values = {
        scene.points.to(torch::kFloat),
        ((scene.colors - 0.5) / 0.28209479177387814).unsqueeze(1),  // 1 / (2 sqrt(pi))
        torch::zeros({count, coefficients - 1, 3}, like),
        torch::full({count, 1}, 0.1, like).logit(),
        log_scales.unsqueeze(1).repeat({1, 3}),
        torch::tensor({1.f, 0.f, 0.f, 0.f}, like).repeat({count, 1})};
    const double rates[] = {0,
                            recipe.feature_lr,
                            recipe.feature_lr / 20,
                            recipe.opacity_lr,
                            recipe.scaling_lr,
                            recipe.rotation_lr};  // that of the positions follows the iteration
    for (int i = 0; i < kCount; ++i) parameters_.push_back({values[i].contiguous().requires_grad_(), rates[i]});
    forget_statistics();
  }

  int64_t count() const { return value(kMeans).size(0); }
  const torch::Tensor& value(Parameter parameter) const { return parameters_[parameter].value; }
  dsmoe::Activated activated() const { return dsmoe::activate(value(kOpacities), value(kScales), value(kRotations)); }

  // means2D gets the gradient that densification reads.
  dsmoe::Rendering render(dsmoe::GaussianRasterizationSettings settings, const torch::Tensor& means2D = {}) const {
    settings.sh_degree = active_sh_degree_;
    const auto [opacities, scales, rotations] = activated();
    dsmoe::RasterizeArguments arguments{.means2D = means2D, .scales = scales, .rotations = rotations};
    arguments.shs = active_sh_degree_ > 0 ? value(kShs) : value(kDc);
    if (active_sh_degree_ > 0) arguments.dc = value(kDc);
    return dsmoe::rasterize(value(kMeans), opacities, settings, arguments);
  }

  void begin_iteration(int iteration) {
    const double share = 1.0 * iteration / recipe_.iterations;
    parameters_[kMeans].lr = extent_ * std::exp((1 - share) * std::log(recipe_.position_lr_init) +
                                                share * std::log(recipe_.position_lr_final));
    if (iteration % recipe_.sh_degree_interval == 0 && active_sh_degree_ < recipe_.sh_degree) ++active_sh_degree_;
  }

  // Between the gradients and the optimizer's step. What is replaced has no gradient: it is not stepped.
  void control_density(int iteration, const torch::Tensor& dL_dmeans2D, const torch::Tensor& radii) {
    const torch::NoGradGuard no_grad;
    if (iteration >= recipe_.densify_until) return;
    dsmoe::add_view(dL_dmeans2D, radii, gradient_sum_, view_count_);
    if (iteration > recipe_.densify_from && iteration % recipe_.densification_interval == 0) {
      densify();
      const auto now = activated();
      auto doomed = now.opacities.squeeze(1) < 0.005;  // and, after the first reset, those larger than a tenth
      if (iteration > recipe_.opacity_reset_interval) doomed |= std::get<0>(now.scales.max(1)) > 0.1 * extent_;
      change_rows(~doomed, {});
      forget_statistics();
    }
    if (iteration % recipe_.opacity_reset_interval == 0) {
      auto& opacities = parameters_[kOpacities];
      opacities.value = activated().opacities.clamp_max(0.01).logit().requires_grad_();
      opacities.moment.reset(), opacities.square.reset();
    }
  }

  void step() {
    // Higher bands have been at zero as long as the base colours have been stepped.
    if (!parameters_[kShs].moment.defined()) parameters_[kShs].step = parameters_[kDc].step;
    step_and_forget_gradients(parameters_, 1e-15);
  }

  // The file of Inria's 3DGS; blend mode and gate are recorded in its comments.
  void save(const std::string& path, const std::string& blend_mode, double background_gate) const {
    const auto numbers = [&](Parameter parameter) {
      const auto tensor = value(parameter).detach().cpu().contiguous();
      return std::vector<float>(tensor.data_ptr<float>(), tensor.data_ptr<float>() + tensor.numel());
    };
    dsmoe::io::GaussianModel model{
        static_cast<size_t>(count()), recipe_.sh_degree, numbers(kMeans),     numbers(kDc), numbers(kShs),
        numbers(kOpacities),          numbers(kScales),  numbers(kRotations), blend_mode};
    if (blend_mode == "smoe" || blend_mode == "smoe_eq7") model.background_gate = background_gate;
    dsmoe::io::write_gaussians(path, model);
  }

 private:
  // Clones small and splits large Gaussians whose mean gradient reaches the threshold.
  void densify() {
    const auto wanted = gradient_sum_ / view_count_.clamp_min(1) >= recipe_.densify_grad_threshold;
    const auto large = std::get<0>(activated().scales.max(1)) > recipe_.percent_dense * extent_;
    const auto clones = (wanted & ~large).nonzero().squeeze(1), parents = (wanted & large).nonzero().squeeze(1);
    // Two children for each parent, at places drawn from its own distribution.
    const auto sources = torch::cat({clones, parents, parents});
    std::vector<torch::Tensor> added;
    for (const auto& parameter : parameters_) added.push_back(parameter.value.detach().index_select(0, sources));
    const auto child = [&](Parameter parameter) { return added[parameter].slice(0, clones.size(0)); };
    const auto offsets = torch::randn_like(child(kScales)) * child(kScales).exp();
    child(kMeans).add_(rotated(offsets, child(kRotations)));
    child(kScales).sub_(std::log(0.8 * 2));
    change_rows(~(wanted & large), added);
  }

  // Keeps the Gaussians where the mask is set and appends others, whose moments are zero.
  void change_rows(const torch::Tensor& mask, const std::vector<torch::Tensor>& added) {
    const auto kept = mask.nonzero().squeeze(1);
    for (int i = 0; i < kCount; ++i) {
      auto& [value, lr, moment, square, step] = parameters_[i];
      const auto more = added.empty() ? value.detach().slice(0, 0, 0) : added[i];
      value = torch::cat({value.detach().index_select(0, kept), more}).requires_grad_();
      for (torch::Tensor* state : {&moment, &square}) {
        if (state->defined()) *state = torch::cat({state->index_select(0, kept), torch::zeros_like(more)});
      }
    }
  }

  void forget_statistics() {
    gradient_sum_ = torch::zeros(count(), value(kMeans).options().requires_grad(false));
    view_count_ = torch::zeros_like(gradient_sum_);
  }

  Recipe recipe_;
  double extent_;
  int active_sh_degree_ = 0;
  std::vector<dsmoe::AdamParameter> parameters_;
  torch::Tensor gradient_sum_, view_count_;  // [N] of the views since the last densification
};
