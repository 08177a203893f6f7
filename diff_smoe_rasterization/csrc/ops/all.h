// All ops that are no stage of the pipeline: a folder each, and a line for it here.
#pragma once

#include "ops/adam/op.h"
#include "ops/contributions/op.h"
#include "ops/gate_map/op.h"
#include "ops/gather/op.h"
#include "ops/gaussians/op.h"
#include "ops/image_loss/op.h"
#include "ops/importance/op.h"
#include "ops/neighbors/op.h"

namespace dsmoe {
namespace binding {

template <class Backend, class Ops> void all_ops(Ops ops) {
  adam_ops<Backend>(ops);
  contributions_ops<Backend>(ops);
  gate_map_ops<Backend>(ops);
  gather_ops<Backend>(ops);
  gaussians_ops<Backend>(ops);
  image_loss_ops<Backend>(ops);
  importance_ops<Backend>(ops);
  neighbors_ops<Backend>(ops);
}

}  // namespace binding
}  // namespace dsmoe
