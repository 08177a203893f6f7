// What the files of the module _core share.
#pragma once

#include <pybind11/pybind11.h>

#include <exception>
#include <string>

namespace dsmoe {

namespace python {

// Text as Python's str; bytes that are not UTF-8 appear as \xNN.
pybind11::str text(const std::string& utf8);

// Sets the Python error of a C++ exception: an OSError, ValueError, MemoryError or RuntimeError.
void translate_exception(std::exception_ptr exception);

}  // namespace python

namespace io {

// Readers and writers of files: io.py calls them.
void add_to(pybind11::module_ module);

}  // namespace io

}  // namespace dsmoe
