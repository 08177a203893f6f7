// Where a program may write: the rule of every tool's -o.
#include "command_line.h"

#include <gtest/gtest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "errors.h"

namespace dsmoe::tools {
namespace {

namespace fs = std::filesystem;

CommandLine line_with(bool overwrite) {
  char program[] = "program", option[] = "--overwrite";
  char* arguments[] = {program, option, nullptr};
  return CommandLine(overwrite ? 2 : 1, arguments, {{"overwrite", 0, false}});
}

class CheckOutput : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::path(testing::TempDir()) / ("dsmoe_output_" + std::to_string(getpid()));
    fs::create_directories(folder_);
  }
  void TearDown() override { fs::remove_all(folder_); }

  std::string made(const char* name) {
    std::ofstream(folder_ / name) << "mine";
    return (folder_ / name).string();
  }

  std::string refusal(const std::string& file, bool overwrite) {
    try {
      line_with(overwrite).check_output(file, folder_.string());
    } catch (const UsageError& error) {
      return error.what();
    }
    return "";
  }

  fs::path folder_;
};

TEST_F(CheckOutput, TakesAFreeName) {
  EXPECT_EQ(refusal((folder_ / "new.png").string(), false), "");
  EXPECT_EQ(refusal((folder_ / "new" / "new.png").string(), false), "");
}

TEST_F(CheckOutput, ReplacesAFileOnlyWhereAsked) {
  const std::string file = made("thèse.png");
  EXPECT_NE(refusal(file, false).find("thèse.png\" is there already; --overwrite"), std::string::npos);
  EXPECT_EQ(refusal(file, true), "");
}

TEST_F(CheckOutput, NeverReplacesWhatIsNoRegularFile) {
  const std::string pipe = (folder_ / "pipe").string(), link = (folder_ / "link").string();
  ASSERT_EQ(mkfifo(pipe.c_str(), 0600), 0);
  fs::create_symlink(made("thesis.png"), link);
  for (const std::string& file : {pipe, link, folder_.string()}) {
    EXPECT_NE(refusal(file, true).find("is not a regular file"), std::string::npos) << file;
  }
}

TEST_F(CheckOutput, WritesNowhereThroughALinkInTheFolder) {
  fs::create_directories(folder_ / "elsewhere");
  fs::create_directory_symlink(folder_ / "elsewhere", folder_ / "link");
  for (const fs::path& folder : {folder_, folder_ / ""}) {  // with and without a slash at its end
    folder_ = folder;
    EXPECT_NE(refusal((folder / "link" / "new.png").string(), true).find("link\" is a link"), std::string::npos);
  }
}

}  // namespace
}  // namespace dsmoe::tools
