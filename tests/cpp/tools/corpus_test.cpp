// The fuzzers' corpus (fuzz/corpus.tar.gz), by every compiler: each file is read, or refused with its name.
#include <gtest/gtest.h>

#include <filesystem>

#include "io_test_support.h"
#include "tools/readers.h"

namespace dsmoe::tools {
namespace {

namespace fs = std::filesystem;

class CorpusOf : public testing::TestWithParam<Reader> {};
INSTANTIATE_TEST_SUITE_P(All, CorpusOf, testing::ValuesIn(readers()),
                         [](const auto& info) { return std::string(info.param.name); });

TEST_P(CorpusOf, IsReadOrRefused) {
  int num_read = 0, num_refused = 0;
  for (const auto& entry : fs::directory_iterator(fs::path(DSMOE_CORPUS) / GetParam().name)) {
    const std::string bytes = io::read_bytes(entry.path().string());
    try {
      GetParam().read(bytes);
      ++num_read;
    } catch (const io::FormatError& error) {
      ++num_refused;
      EXPECT_EQ(std::string(error.what()).rfind("file", 0), 0u) << entry.path() << ": " << error.what();
    }  // any other exception fails the test
  }
  EXPECT_GT(num_read, 0);
  EXPECT_GT(num_refused, 0);
}

}  // namespace
}  // namespace dsmoe::tools
