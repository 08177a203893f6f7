#pragma once

#include <pybind11/pybind11.h>

namespace dsmoe::io {

/// Adds the readers and writers to a Python module; diff_smoe_rasterization/io.py documents and wraps them.
/// FileError becomes OSError (its subclass by errno, such as FileNotFoundError), FormatError becomes ValueError.
void bind_io(pybind11::module_& module);

}  // namespace dsmoe::io
