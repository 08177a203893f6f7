# find_package(diff_smoe_rasterization) of the Python package: cmake -DCMAKE_PREFIX_PATH="$(dsmoe info --cmake)".
# dsmoe::torch is _ops.so, which is linked with the PyTorch that it was built against; all other targets are
# libdsmoe.so, which needs none. PyTorch is found here and not by find_package(Torch): of builds with CUDA, that asks for
# a whole CUDA toolkit. A project that has found Torch before keeps its own. A build by the stable ABI has no dsmoe::torch.
get_filename_component(dsmoe_package "${CMAKE_CURRENT_LIST_DIR}" DIRECTORY)

# What setup.py wrote down: NAME = 'TEXT' or True; empty for None and False.
function(dsmoe_build_info name result)
  file(STRINGS "${dsmoe_package}/_build_info.py" line REGEX "^${name} = ")
  string(REGEX MATCH "'[^']*'|True" value "${line}")
  string(REPLACE "'" "" value "${value}")
  set(${result} "${value}" PARENT_SCOPE)
endfunction()
dsmoe_build_info(TORCH_VERSION dsmoe_torch_version)
dsmoe_build_info(CUDA_VERSION dsmoe_cuda_version)
dsmoe_build_info(CXX11_ABI dsmoe_cxx11_abi)
dsmoe_build_info(STABLE_ABI_SINCE dsmoe_stable_abi)

set(dsmoe_components core io)
if(dsmoe_cuda_version)
  list(APPEND dsmoe_components cuda)
endif()
foreach(name IN LISTS dsmoe_components)
  set(diff_smoe_rasterization_${name}_FOUND TRUE)
  if(NOT TARGET dsmoe::${name})
    add_library(dsmoe::${name} SHARED IMPORTED)
    set_target_properties(dsmoe::${name} PROPERTIES
      IMPORTED_LOCATION "${dsmoe_package}/libdsmoe.so"
      INTERFACE_INCLUDE_DIRECTORIES "${dsmoe_package}/include"
      INTERFACE_COMPILE_DEFINITIONS "_GLIBCXX_USE_CXX11_ABI=$<BOOL:${dsmoe_cxx11_abi}>"
      INTERFACE_COMPILE_FEATURES cxx_std_17
      INTERFACE_LINK_OPTIONS -Wl,--allow-shlib-undefined)
  endif()
endforeach()

if(dsmoe_stable_abi)
  set(dsmoe_no_torch "This build works with many releases of PyTorch, and so has no dsmoe::torch. Build it from source, \
without DSMOE_STABLE_ABI.")
elseif(TARGET torch)
  set(dsmoe_libtorch torch)
else()
  set(dsmoe_hints "${dsmoe_package}/../torch")
  foreach(prefix IN LISTS CMAKE_PREFIX_PATH)
    list(APPEND dsmoe_hints "${prefix}/../..")  # of torch.utils.cmake_prefix_path
  endforeach()
  find_path(DSMOE_LIBTORCH NAMES lib/libtorch_cpu.so HINTS ${dsmoe_hints} NO_DEFAULT_PATH)
  set(dsmoe_found_version "none")
  if(DSMOE_LIBTORCH)
    file(STRINGS "${DSMOE_LIBTORCH}/version.py" line REGEX "^__version__")
    string(REGEX MATCH "'(.*)'" line "${line}")
    set(dsmoe_found_version "${CMAKE_MATCH_1}")
  endif()
  set(dsmoe_libtorch dsmoe::libtorch)
  if(NOT dsmoe_found_version STREQUAL dsmoe_torch_version)
    set(dsmoe_libtorch "")
    set(dsmoe_no_torch "dsmoe::torch was built against torch ${dsmoe_torch_version}; found is ${dsmoe_found_version} \
(${DSMOE_LIBTORCH}). CMAKE_PREFIX_PATH=\"$(dsmoe info --cmake)\" names both.")
  elseif(NOT TARGET dsmoe::libtorch)
    set(dsmoe_names torch torch_cpu c10)
    if(dsmoe_cuda_version)
      list(APPEND dsmoe_names torch_cuda c10_cuda)
    endif()
    list(TRANSFORM dsmoe_names REPLACE "(.+)" "${DSMOE_LIBTORCH}/lib/lib\\1.so" OUTPUT_VARIABLE dsmoe_files)
    add_library(dsmoe::libtorch INTERFACE IMPORTED)
    # A program loads them itself, by its own path, even where it calls none: so _ops.so gets these and no others. What
    # they need in turn is their own affair. The linker would look for it beside the CUDA toolkit too, which may hold
    # another release, of NCCL for example.
    set_target_properties(dsmoe::libtorch PROPERTIES
      INTERFACE_INCLUDE_DIRECTORIES "${DSMOE_LIBTORCH}/include;${DSMOE_LIBTORCH}/include/torch/csrc/api/include"
      INTERFACE_COMPILE_FEATURES "$<IF:$<VERSION_LESS:${dsmoe_torch_version},2.13>,cxx_std_17,cxx_std_20>"
      INTERFACE_LINK_LIBRARIES "-Wl,--push-state,--no-as-needed;${dsmoe_files};-Wl,--pop-state")
  endif()
endif()
if(dsmoe_libtorch)
  set(diff_smoe_rasterization_torch_FOUND TRUE)
  if(NOT TARGET dsmoe::torch)
    add_library(dsmoe::torch SHARED IMPORTED)
    # A program has PyTorch's libstdc++, also from a toolchain that links a static one. PyTorch would take some symbols
    # from that, and others from its own: streams would stay without their constructor, and a warning would crash.
    set_target_properties(dsmoe::torch PROPERTIES
      IMPORTED_LOCATION "${dsmoe_package}/_ops.so"
      INTERFACE_INCLUDE_DIRECTORIES "${dsmoe_package}/include"
      INTERFACE_LINK_OPTIONS -Wl,--push-state,--no-as-needed,-l:libstdc++.so.6,--pop-state
      INTERFACE_LINK_LIBRARIES "dsmoe::core;${dsmoe_libtorch}")
  endif()
endif()
set_property(TARGET dsmoe::io PROPERTY INTERFACE_INCLUDE_DIRECTORIES "${dsmoe_package}/csrc")  # "io/ply.h"
if("cuda" IN_LIST diff_smoe_rasterization_FIND_COMPONENTS AND TARGET dsmoe::cuda)  # its callers have device pointers
  include(CMakeFindDependencyMacro)
  if(diff_smoe_rasterization_FIND_REQUIRED_cuda)
    find_dependency(CUDAToolkit)
  else()
    find_package(CUDAToolkit QUIET)
  endif()
  if(CUDAToolkit_FOUND)
    set_property(TARGET dsmoe::cuda APPEND PROPERTY INTERFACE_LINK_LIBRARIES CUDA::cudart)
  endif()
endif()
foreach(name IN LISTS diff_smoe_rasterization_FIND_COMPONENTS)
  if(NOT diff_smoe_rasterization_${name}_FOUND AND diff_smoe_rasterization_FIND_REQUIRED_${name})
    set(diff_smoe_rasterization_FOUND FALSE)
    if(name STREQUAL "cuda")
      set(diff_smoe_rasterization_NOT_FOUND_MESSAGE "This build has no dsmoe::cuda; `dsmoe info` says why.")
    elseif(name STREQUAL "torch")
      set(diff_smoe_rasterization_NOT_FOUND_MESSAGE "${dsmoe_no_torch}")
    else()
      set(diff_smoe_rasterization_NOT_FOUND_MESSAGE
        "There is no component ${name}; the components are core, io, cuda and torch.")
    endif()
  endif()
endforeach()
