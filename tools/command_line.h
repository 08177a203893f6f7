// Command lines: options by getopt_long, and their values as numbers. Errors name the option and what it must be.
#pragma once

#include <map>
#include <string>
#include <vector>

namespace dsmoe::tools {

/// An option of a program.
struct OptionRule {
  const char* name;         // without the two dashes
  char letter = 0;          // a short name, or 0
  bool takes_value = true;  // else it is a flag
};

/// What a command line says.
class CommandLine {
 public:
  /// Throws UsageError for an option that is not in `rules`, twice there, or without its value.
  CommandLine(int argc, char** argv, const std::vector<OptionRule>& rules);

  bool has(const std::string& name) const { return values_.count(name) != 0; }
  const std::vector<std::string>& arguments() const { return arguments_; }  // that belong to no option

  // Each returns `missing` if the option is absent.
  std::string text(const std::string& name, const std::string& missing) const;
  double number(const std::string& name, double missing, double least, double most) const;
  int whole(const std::string& name, int missing, int least, int most) const;
  /// One of `choices`.
  std::string choice(const std::string& name, const std::string& missing,
                     const std::vector<std::string>& choices) const;
  /// `count` finite numbers with commas between them.
  std::vector<double> numbers(const std::string& name, const std::vector<double>& missing, std::size_t count) const;

  /// The rule for a file that a program writes: it is not there, or it is a regular file and --overwrite is given, and
  /// no link lies between `folder` and it. `folder` may still be to make, any other folder is there. Throws UsageError.
  void check_output(const std::string& file, const std::string& folder = "") const;

 private:
  std::map<std::string, std::string> values_;
  std::vector<std::string> arguments_;
};

/// Splits text at a character; "a,,b" has three parts.
std::vector<std::string> split(const std::string& text, char separator);

}  // namespace dsmoe::tools
