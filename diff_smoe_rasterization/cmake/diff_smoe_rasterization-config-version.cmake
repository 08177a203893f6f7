# As CMake's COMPATIBILITY SameMinorVersion, of the version in _version.py.
file(STRINGS "${CMAKE_CURRENT_LIST_DIR}/../_version.py" dsmoe_line REGEX "^__version__")
string(REGEX MATCH "([0-9]+\\.[0-9]+)\\.[0-9]+" PACKAGE_VERSION "${dsmoe_line}")
set(dsmoe_minor "${CMAKE_MATCH_1}")
if("${PACKAGE_FIND_VERSION_MAJOR}.${PACKAGE_FIND_VERSION_MINOR}" STREQUAL dsmoe_minor
   AND NOT PACKAGE_VERSION VERSION_LESS PACKAGE_FIND_VERSION)
  set(PACKAGE_VERSION_COMPATIBLE TRUE)
  string(COMPARE EQUAL "${PACKAGE_VERSION}" "${PACKAGE_FIND_VERSION}" PACKAGE_VERSION_EXACT)
endif()
