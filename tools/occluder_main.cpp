// dsmoe_occluder: the paper's Figure 8.
#include <algorithm>
#include <cstdio>
#include <thread>

#include "command_line.h"
#include "errors.h"
#include "occluder.h"
#include "picture.h"

namespace dsmoe::tools {
namespace {

constexpr char kHelp[] = R"(usage: dsmoe_occluder -o PICTURE.png [OPTION...]

Draws red bars behind an opaque blue panel (Figure 8 of the paper): smoe, smoe_tn and smoe_std, side by side. Where
the gates know no transmittance, the bars show through the panel. The terminal gets, of the pixels of the panel
that have a bar behind them,

  leak      how much red the bars add
  change    how much the bars change a channel, in the mean

Options
  --blends A,B,...  which, in this order. Default: smoe,smoe_tn,smoe_std; alpha and smoe_eq7 are others
  --size N          pixels a side. Default: 256
  --threads N       Default: all processors
  --overwrite       replace PICTURE.png where it is there
)";

int run(int argc, char** argv) {
  const CommandLine line(
      argc, argv, {{"help", 'h', false}, {"output", 'o'}, {"blends"}, {"size"}, {"threads"}, {"overwrite", 0, false}});
  if (line.has("help") || argc == 1) {
    std::fputs(kHelp, stdout);
    return 0;
  }
  const std::string output = line.text("output", "");
  if (output.empty() || !line.arguments().empty()) throw UsageError("-o PICTURE.png is needed, and nothing else");
  line.check_output(output);
  const int size = line.whole("size", 256, 16, 4096);
  const int threads = line.whole("threads", static_cast<int>(std::thread::hardware_concurrency()), 1, 4096);
  const std::vector<std::string> names = blend_names();
  std::vector<Picture> pictures;
  for (const std::string& name : split(line.text("blends", "smoe,smoe_tn,smoe_std"), ',')) {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end()) throw UsageError("--blends has \"" + name + "\", which is not a blend");
    const auto mode = static_cast<BlendMode>(found - names.begin());
    const OccluderRendering rendering = render_occluder(mode, size, threads);
    std::printf("%-8s leak %7.4f  change %.4f\n", name.c_str(), rendering.ghost.leak, rendering.ghost.change);
    pictures.push_back({size, size, 3, rendering.images.color});
  }
  write_picture(output, side_by_side(pictures));
  return 0;
}

}  // namespace
}  // namespace dsmoe::tools

int main(int argc, char** argv) {
  return dsmoe::tools::run_tool("dsmoe_occluder", [&] { return dsmoe::tools::run(argc, argv); });
}
