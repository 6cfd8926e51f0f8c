// The distance of a grid's nodes to one view's silhouette cone (paper, "Observed geometry").
#pragma once

#include "api.h"

namespace splash {

void carve(const SplashCarving&, int threads);

}  // namespace splash
