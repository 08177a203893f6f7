// What goes wrong in a tool, and the frame of every main().
#pragma once

#include <cstdio>
#include <exception>
#include <filesystem>
#include <new>
#include <stdexcept>
#include <string>

namespace dsmoe::tools {

/// A command line that makes no sense: exit status 2, with a pointer to --help. Other exceptions are status 1.
class UsageError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Calls body(), which returns the exit status, and turns what it throws into one line on stderr.
template <class Body> int run_tool(const char* name, Body body) {
  try {
    return body();
  } catch (const UsageError& error) {
    std::fprintf(stderr, "%s: %s (%s --help explains)\n", name, error.what(), name);
    return 2;
  } catch (const std::filesystem::filesystem_error& error) {
    std::fprintf(stderr, "%s: %s: %s\n", name, error.path1().c_str(), error.code().message().c_str());
    return 1;
  } catch (const std::bad_alloc&) {
    std::fprintf(stderr, "%s: the machine is out of memory\n", name);
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", name, error.what());
    return 1;
  }
}

}  // namespace dsmoe::tools
