// The packs' exponential, one array at a time, for each instruction set that the compiler can build for.
#pragma once

namespace dsmoe {

struct PackExp {
  int bits;  // of a register
  // Reads and writes a multiple of 64 bytes; no alignment is asked for.
  void (*in_float)(const float* x, float* result, int count);
  void (*in_double)(const double* x, double* result, int count);
};
extern const PackExp kBaselinePackExp;
#if defined(__x86_64__)
extern const PackExp kAvx2PackExp, kAvx512PackExp;
#endif

}  // namespace dsmoe
