// The functions of csrc/io for Python, with numpy arrays.
#pragma once

#include "python/python.h"

namespace dsmoe::io {

// The module _C.io.
python::Object make_module();

}  // namespace dsmoe::io
