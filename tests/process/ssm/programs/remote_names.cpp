// SPDX-License-Identifier: Apache-2.0
//
// An SSM program that reads and writes streams of another PC without knowing more of it than its
// name. Arguments: FOLDER HOST PID; the dssmd of this PC, process PID, knows that host, which has a
// stream "far:3" of ten samples and a property.
#include <libssm.h>

#include <ssm.hpp>
#include <string>

#include "check.h"

namespace {

struct Point {
  int number;
  double x;
};

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  const std::string host = argv[2];
  CHECK(initSSM());

  // By its name alone, and with the host's.
  const std::string names[] = {"far", "far@" + host};
  for (int i = 0; i < 2; ++i) {
    SSMApi<Point, int> far(names[i].c_str(), 3);
    CHECK(far.openWait(0.0));
    CHECK(far.getProperty());
    CHECK_EQUAL(far.property, 99);
    CHECK(far.readLast());
    CHECK_EQUAL(far.timeId, 9);
    CHECK_EQUAL(far.data.number, 9);
    CHECK(far.readTime(1004.5) && far.data.number == 4);
    CHECK(far.readBack(4) && far.data.number == 0);
    CHECK(std::string(far.getStreamName()) == names[i]);
    // An edge as to any reader; here dssmd writes what comes from the other PC.
    char edge_name[SSM_SNAME_MAX];
    int edge_id = 0, source = 0, opener = 0, mode = 0, node = 0;
    CHECK_EQUAL(getSSM_edge_num(), 1);
    CHECK(getSSM_edge_info(0, edge_name, sizeof(edge_name), &edge_id, &source, &opener, &mode));
    CHECK(strcmp(edge_name, "far") == 0 && edge_id == 3 && opener == getpid() && mode == SSM_READ);
    CHECK_EQUAL(getSSM_node_num(), 2);
    CHECK(getSSM_node_info(0, &node) && node == getpid());
    CHECK(getSSM_node_info(1, &node) && node == source);
    CHECK_EQUAL(source, atoi(argv[3]));
    size_t size = 0, property = 0;
    int num = 0;
    double cycle = 0;
    CHECK_EQUAL(getSSM_info(names[i].c_str(), 3, &size, &num, &cycle, &property), sizeof(Point));
    CHECK_EQUAL(size, sizeof(Point));
    CHECK_EQUAL(num, 100);
    CHECK_EQUAL(property, sizeof(int));
    CHECK(far.close());
    while (getSSM_edge_num() != 0) usleep(1000);
  }
  CHECK_EQUAL(getSSM_node_num(), 1);
  CHECK_EQUAL(getSSM_num(), 0);  // lists what is of this PC

  // A stream of ours over there.
  SSMApi<Point> ours(("ours@" + host).c_str(), 0);
  CHECK(ours.create(1.0, 0.1));
  for (int i = 0; i < 5; ++i) {
    ours.data.number = i;
    CHECK(ours.write(2000.0 + i));
    CHECK_EQUAL(ours.timeId, i);
  }
  SSM_sid sid = openSSM(("ours@" + host).c_str(), 0, SSM_READ);
  CHECK(sid != 0);
  Point point;
  while (readSSM(sid, &point, NULL, -1) < 0 || point.number != 4) usleep(1000);
  CHECK(closeSSM(&sid));

  // The limit is for the name, not for what is behind the '@'.
  const std::string longest(31, 'n'), too_long(32, 'n');
  sid = createSSM((longest + "@" + host).c_str(), 0, sizeof(Point), 1, 0.1);
  CHECK(sid != 0);
  closeSSM(&sid);
  sid = openSSM((longest + "@" + host).c_str(), 0, SSM_READ);
  CHECK(sid != 0);
  closeSSM(&sid);
  CHECK_EQUAL(getSSM_info((longest + "@" + host).c_str(), 0, NULL, NULL, NULL, NULL),
              sizeof(Point));
  catch_stderr();
  CHECK(createSSM((too_long + "@" + host).c_str(), 0, sizeof(Point), 1, 0.1) == 0);
  CHECK(createSSM("far@", 0, sizeof(Point), 1, 0.1) == 0);
  CHECK(createSSM("far@nobody", 0, sizeof(Point), 1, 0.1) == 0);
  CHECK_TEXT(caught_stderr(), "nobody");
  CHECK(openSSM("far@nobody", 3, SSM_READ) == 0);
  CHECK(openSSM("far@", 3, SSM_READ) == 0);
  CHECK(endSSM());
  return check_result();
}
