#include "command_line.h"

#include <getopt.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "errors.h"
#include "io/cursor.h"

namespace dsmoe::tools {

namespace {

// A path whole, however long: its end tells which file it is.
std::string quoted(const std::string& path) { return io::printable(path, path.size()); }

}  // namespace

CommandLine::CommandLine(int argc, char** argv, const std::vector<OptionRule>& rules) {
  std::string letters = ":";  // first: getopt leaves the messages to us
  std::vector<option> options;
  for (const OptionRule& rule : rules) {
    options.push_back({rule.name, rule.takes_value ? required_argument : no_argument, nullptr, 0});
    if (rule.letter != 0) letters += std::string(1, rule.letter) + (rule.takes_value ? ":" : "");
  }
  options.push_back({nullptr, 0, nullptr, 0});
  optind = 0;  // from the beginning, also in a second command line of the same process
  for (;;) {
    int index = -1;
    const int found = getopt_long(argc, argv, letters.c_str(), options.data(), &index);
    if (found == -1) break;
    if (found == ':') throw UsageError(std::string(argv[optind - 1]) + " needs a value");
    if (found == '?') throw UsageError("there is no option " + std::string(argv[optind - 1]));
    const auto rule = index >= 0 ? rules.begin() + index
                                 : std::find_if(rules.begin(), rules.end(),
                                                [&](const OptionRule& known) { return known.letter == found; });
    if (!values_.emplace(rule->name, optarg != nullptr ? optarg : "").second) {
      throw UsageError("--" + std::string(rule->name) + " is there twice");
    }
  }
  arguments_.assign(argv + optind, argv + argc);
}

std::string CommandLine::text(const std::string& name, const std::string& missing) const {
  const auto found = values_.find(name);
  return found == values_.end() ? missing : found->second;
}

double CommandLine::number(const std::string& name, double missing, double least, double most) const {
  if (!has(name)) return missing;
  double value = 0;
  if (!io::parse_number(values_.at(name), value) || !(value >= least && value <= most)) {
    throw UsageError("--" + name + " is " + io::printable(values_.at(name)) + "; it must be a number from " +
                     io::shortest_text(least) + " to " + io::shortest_text(most));
  }
  return value;
}

int CommandLine::whole(const std::string& name, int missing, int least, int most) const {
  const double value = number(name, missing, least, most);
  if (value != std::floor(value)) throw UsageError("--" + name + " must be a whole number");
  return static_cast<int>(value);
}

std::string CommandLine::choice(const std::string& name, const std::string& missing,
                                const std::vector<std::string>& choices) const {
  std::string value = text(name, missing);
  if (!has(name) || std::find(choices.begin(), choices.end(), value) != choices.end()) return value;
  std::string known;
  for (const std::string& choice : choices) known += (known.empty() ? "" : ", ") + choice;
  throw UsageError("--" + name + " is " + io::printable(value) + "; it must be one of " + known);
}

std::vector<double> CommandLine::numbers(const std::string& name, const std::vector<double>& missing,
                                         std::size_t count) const {
  if (!has(name)) return missing;
  std::vector<double> values;
  for (const std::string& part : split(values_.at(name), ',')) {
    double value = 0;
    if (!io::parse_number(part, value) || !std::isfinite(value)) break;
    values.push_back(value);
  }
  if (values.size() != count || split(values_.at(name), ',').size() != count) {
    throw UsageError("--" + name + " is " + io::printable(values_.at(name)) + "; it must be " + std::to_string(count) +
                     " numbers with commas between them");
  }
  return values;
}

void CommandLine::check_output(const std::string& file, const std::string& folder) const {
  namespace fs = std::filesystem;
  std::error_code ignored;
  if (!folder.empty()) {
    fs::path place = folder;
    for (const fs::path& part : fs::path(file).lexically_relative(folder).parent_path()) {
      place /= part;
      if (fs::is_symlink(place, ignored)) {
        throw UsageError(quoted(place.string()) + " is a link, and nothing is written there; -o names another");
      }
    }
  } else if (const fs::path place = fs::path(file).parent_path(); !place.empty() && !fs::is_directory(place, ignored)) {
    throw UsageError(quoted(file) + " has no folder to be in: make " + quoted(place.string()) +
                     ", or name another by -o");
  }
  const fs::file_status status = fs::symlink_status(file, ignored);
  if (!fs::exists(status)) return;
  if (!fs::is_regular_file(status)) {
    throw UsageError(quoted(file) + " is not a regular file, which is never replaced; -o names another");
  }
  if (!has("overwrite")) {
    throw UsageError(quoted(file) + " is there already; --overwrite replaces it, -o names another");
  }
}

std::vector<std::string> split(const std::string& text, char separator) {
  std::vector<std::string> parts(1);
  for (const char c : text) {
    if (c == separator) {
      parts.emplace_back();
    } else {
      parts.back() += c;
    }
  }
  return parts;
}

}  // namespace dsmoe::tools
