// Chooses the instruction set of the blend at run time, because a build for one machine must run on another.
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <vector>

#include "dsmoe/rasterize.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {
namespace {

// Best first.
std::vector<const SimdLevel*> supported_levels() {
  std::vector<const SimdLevel*> levels;
#if defined(__x86_64__)
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq");
  if (avx512) levels.push_back(&kAvx512Level);
  if (avx2) levels.push_back(&kAvx2Level);
#endif
  levels.push_back(&kBaselineLevel);
  return levels;
}

const SimdLevel& choose_level() {
  const auto levels = supported_levels();
  const char* wanted = std::getenv("DSMOE_SIMD");
  if (wanted == nullptr || *wanted == '\0') return *levels.front();
  std::string names;
  for (const SimdLevel* level : levels) {
    if (std::string(wanted) == level->name) return *level;
    names += std::string(names.empty() ? "" : ", ") + level->name;
  }
  throw std::invalid_argument("DSMOE_SIMD is \"" + std::string(wanted) + "\"; this processor has " + names);
}

}  // namespace

const SimdLevel& current_simd_level() {
  static const SimdLevel& level = choose_level();
  return level;
}

const char* simd_level() { return current_simd_level().name; }

}  // namespace cpu
}  // namespace dsmoe
