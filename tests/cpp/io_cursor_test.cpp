// Text of a file or of a command line as it stands in a message.
#include <gtest/gtest.h>

#include "io/cursor.h"

namespace dsmoe::io {
namespace {

TEST(Printable, IsTheTextItselfInQuotationMarks) {
  for (const char* text : {"", "a b.ply", "Gem\u00e4lde \u00b5.ply", "\u6a21\u578b", "\U0001f98a.ply"}) {
    EXPECT_EQ(printable(text), std::string("\"") + text + "\"");
  }
}

TEST(Printable, ShowsControlCharactersAndWhatIsNotUtf8AsBytes) {
  EXPECT_EQ(printable("a\tb\n\x7f\x1b[31m"), R"("a\x09b\x0a\x7f\x1b[31m")");
  EXPECT_EQ(printable("\xc2\x9b\x31m"), R"("\xc2\x9b1m")");  // U+009B begins an escape sequence too
  EXPECT_EQ(printable("caf\xe9 2"), R"("caf\xe9 2")");       // Latin-1
  EXPECT_EQ(printable("\xc3"), R"("\xc3")");                 // the end is missing
  EXPECT_EQ(printable("\xe2\x82\xc3\xa4"), "\"\\xe2\\x82\u00e4\"");
  EXPECT_EQ(printable("\xc1\xa1\xe0\x81\xa1\xf0\x80\x81\xa1"),
            R"("\xc1\xa1\xe0\x81\xa1\xf0\x80\x81\xa1")");  // overlong a
  EXPECT_EQ(printable("\xed\xa0\x80\xf4\x90\x80\x80\xff"), R"("\xed\xa0\x80\xf4\x90\x80\x80\xff")");
}

TEST(Printable, IsCutBetweenCharacters) {
  EXPECT_EQ(printable("abcd", 4), "\"abcd\"");
  EXPECT_EQ(printable("abcde", 4), "\"abcd...\"");
  EXPECT_EQ(printable("abc\u00e4", 4), "\"abc...\"");
  EXPECT_EQ(printable("ab\u00e4", 4), "\"ab\u00e4\"");
}

}  // namespace
}  // namespace dsmoe::io
