// SPDX-License-Identifier: Apache-2.0
//
// Programs for the paper's prototype, and for the versions between it and the old DSSM. Arguments:
// FOLDER ADDRESS.
#include "check.h"
#include "ssm-proxy-client-child.hpp"
#include "ssm-proxy-client.hpp"

namespace {

struct Point {
  int number;
};
struct Mounting {
  double height;
};

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  char* address = argv[2];
  PConnectorClient<Point, Mounting>* writer =
      new PConnectorClient<Point, Mounting>("prototype", 1, address);
  CHECK(writer->initSSM());
  CHECK(writer->create(5.0, 0.1));
  writer->property.height = 2;
  CHECK(writer->setProperty());
  CHECK(writer->createDataCon());
  writer->wdata->number = 42;
  CHECK(writer->write(7.0));

  PConnectorClient<Point, Mounting> reader("prototype", 1, address);
  CHECK(reader.initSSM() && reader.open(SSM_READ));
  CHECK(reader.getProperty());
  CHECK_SAME(reader.property.height, 2);
  CHECK(reader.createDataCon());
  while (!reader.readNew()) usleep(1000);
  CHECK_EQUAL(reader.data.number, 42);
  CHECK_SAME(reader.time, 7);

  PConnectorClient<Point> between("prototype", 1, address);
  CHECK(between.initSSM() && between.open(SSM_EXCLUSIVE) && between.UDPcreateDataCon());
  between.readyRingBuf(512);  // entries once, seconds now
  while (between.getTID_topBuf(0) < 0) usleep(1000);
  CHECK(between.readLastBuf());
  CHECK_EQUAL(between.data.number, 42);

  PConnector* plain = new PConnector();
  plain->setIpAddress(address);
  CHECK(plain->initSSM());
  Point point = {0};
  char full[sizeof(ssmTimeT) + sizeof(Point)];
  plain->setStream("prototype", 1);
  plain->setBuffer(&point, sizeof(point), NULL, 0, full);
  CHECK(plain->open() && plain->createDataCon() && plain->readLast());
  CHECK_EQUAL(point.number, 42);
  point.number = 43;
  memcpy(full + sizeof(ssmTimeT), &point, sizeof(point));
  CHECK(plain->write(8.0));
  while (!reader.readNew()) usleep(1000);
  CHECK_EQUAL(reader.data.number, 43);
  CHECK(plain->terminate());
  delete plain;
  CHECK(writer->terminate());
  delete writer;  // "free(): invalid pointer", once
  PConnectorClient<Point> never;
  return check_result();
}
