// Every threshold of the rasterizer, named, with its reason. Thresholds that decide whether a pair counts are
// float32 values in every scalar type: (1 - 0.99f)^2 < 1e-4f stops a pixel, the same in double does not.
#pragma once

namespace dsmoe {

constexpr float kAlphaMax = 0.99f;          // alpha never reaches 1, so that transmittance can be divided back
constexpr float kAlphaCut = 1.0f / 255.0f;  // `alpha` mode skips fainter pairs: invisible in 8 bits
constexpr float kGateCut = 1e-5f;           // `smoe_eq7` and the ablations skip smaller kernels G (the paper's text)
// `smoe`, the rule of the paper's authors: a pair of alpha >= kStrongAlpha is strong. A weaker one is a tail: it only
// adds to the background's weight. If a tail matters some pair is strong, so that the denominator is at least
// kStrongAlpha. So a tail below kTailAlpha moves a pixel by less than 1/255. If a caller wants all pairs in every
// pixel, it also wants all tails that a float32 pixel can feel: 2^-35 is half a unit of the last digit of kStrongAlpha.
constexpr float kStrongAlpha = 1.0f / 2040.0f;
constexpr float kTailAlpha = 1.0f / (2040.0f * 255.0f);
constexpr float kEveryTailAlpha = 0x1p-35f;
// Faint pairs and tails count if the gate sum of the near pairs is below this, unless a caller says otherwise. 0.9
// has the same quality and takes 1.2 to 1.3 times as long; 0.1 loses 0.1 dB (benchmarks/NOTES.md).
constexpr float kFaintBelow = 0.25f;
constexpr float kFaintEverywhere = 2.0f;  // no gate sum of a mode that has faint pairs is above 1
// exp(-4.5), G at 3 sigma. Under a background gate lambda a pair changes a pixel by at most alpha / lambda. So pairs
// with alpha < lambda / 255 do not count, as in `alpha` mode. Inside 3 sigma they do: a Gaussian that is cut everywhere
// has no gradient, and would never come back. For the same reason such a pair is faint only below kCoreAlpha: a cut at
// 1/255 there loses 0.2 dB of models with many faint Gaussians.
constexpr float kCoreKernel = 0.011108996538242306f;
constexpr float kCoreAlpha = kAlphaCut / 4;
constexpr double kLog2AlphaCut = -7.994353351539342, kLog2CoreAlpha = kLog2AlphaCut - 2;  // of the two floats
constexpr double kLog2CoreKernel = -6.492127708889321;                                    // of the float
constexpr float kTransmittanceCut = 1e-4f;     // a pixel is full if the next pair would leave less
constexpr float kMaxOpacity = 1e20f;           // with a larger opacity, gradients by a place overflow in float
constexpr float kGateSumCut = 1e-30f;          // below it no gate is open: the pixel takes the background
constexpr float kRadiusRootFloor = 0.1f;       // keeps the larger eigenvalue's root real for round Gaussians
constexpr float kCompensationFloor = 2.5e-5f;  // antialiasing: the determinant ratio is not taken below this

constexpr double kLowPass = 0.3;              // px^2 added to the projected covariance: no splat thinner than a pixel
constexpr double kFrustumMargin = 1.3;        // the Jacobian is taken at most this many tan(fov / 2) off the axis
constexpr double kHomogeneousEpsilon = 1e-7;  // added to w before the perspective division

constexpr int kTileSize = 16;  // pixels; also the grid of Inria's tile rectangle
// Pixels of an image, each way: CUDA's lists have 16 bits for a row or a column of macro tiles of 64 pixels.
constexpr int kMostImageSide = 65535 * 64;

// Tile and row tests are bounds: every pixel that counts must pass. This is far above their rounding errors, and
// widens a footprint by less than a hundredth of a pixel at sigma = 1.
constexpr double kFootprintSlack = 1e-3;

}  // namespace dsmoe
