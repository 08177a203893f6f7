// libFuzzer on one reader, which the environment variable DSMOE_READER names.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "tools/readers.h"

namespace {

const dsmoe::tools::Reader* g_reader = nullptr;

}  // namespace

extern "C" int LLVMFuzzerInitialize(int*, char***) {
  const char* name = std::getenv("DSMOE_READER");
  for (const dsmoe::tools::Reader& reader : dsmoe::tools::readers()) {
    if (name != nullptr && std::string(name) == reader.name) g_reader = &reader;
  }
  if (g_reader != nullptr) return 0;
  std::fprintf(stderr, "DSMOE_READER must be one of");
  for (const dsmoe::tools::Reader& reader : dsmoe::tools::readers()) std::fprintf(stderr, " %s", reader.name);
  std::fprintf(stderr, "\n");
  std::exit(2);
}

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  try {
    g_reader->read(std::string(reinterpret_cast<const char*>(data), size));
  } catch (const dsmoe::io::FormatError&) {
  }  // any other exception ends the fuzzer
  return 0;
}
