// Compiles a function once per instruction set. The loader takes the best one that the processor has. The results are
// the same bits in each, because no compiler flag lets products and sums become fused.
#pragma once

#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define DSMOE_MULTIVERSION __attribute__((target_clones("avx2", "default")))
#else
#define DSMOE_MULTIVERSION
#endif
