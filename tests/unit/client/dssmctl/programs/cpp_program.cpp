// SPDX-License-Identifier: Apache-2.0
//
// A program in C++ that has streams as SSM's programs have them.
#include <array>

#include "samples.h"

// As far as debug information shows it, SSM's.
class SSMDummy {};
template <typename T, typename P = SSMDummy>
class SSMApi {
 public:
  T data;
  P property;
};

namespace nav {

struct Base {
  int64_t stamp;
};
struct Header {
  uint16_t sequence;
};
enum class Quality : uint8_t { bad, good };

// Derived, with functions, a static member, and more fields than a type may have in `many`.
struct Scan : Base, Header {
  virtual ~Scan() = default;
  static int count;
  std::array<double, 4> ranges;
  std::array<Point, 2> corners;
  Quality quality;
  char32_t letter;
  struct {
    float inner;
  } named;
  struct Cell {
    uint8_t a[2], b;
  };
  Cell many[1100];
};
int Scan::count = 0;

// Of the same size as Spur_Odometry, and no stream's.
struct Other {
  double a[5];
};

struct alignas(32) Aligned {
  float value;
};

struct Shared {
  int value;
};
struct Virtual : virtual Shared {
  int own;
};

}  // namespace nav

typedef unsigned char Image[640 * 480 * 3];

SSMApi<Spur_Odometry> odometry;
SSMApi<nav::Scan, nav::Header> scan;
SSMApi<Image> image;
SSMApi<int> counter;
nav::Other other;
nav::Aligned aligned;
nav::Virtual with_virtual_base;
Everything* everything;
Packed* packed;

int use_local_type() {
  struct Local {
    int first, second, third;
  } local = {1, 2, 3};
  return local.first + local.second + local.third;
}
unsigned long use_them() { return sizeof *everything + sizeof *packed; }
