// SPDX-License-Identifier: Apache-2.0
//
// Buffered reading: a thread collects the stream, the ...Buf functions read what it has. Arguments:
// FOLDER ADDRESS.
#include <sys/wait.h>

#include "check.h"
#include "dssm.hpp"

namespace {

struct Point {
  int number;
  char rest[60];
};

const char* address;
DSSMApi<Point>* writer;

void write_one(int number) {
  writer->wdata->number = number;
  memset(writer->wdata->rest, number % 128, sizeof(writer->wdata->rest));
  CHECK(writer->write(1000.0 + number));
}

bool whole(const Point& point) {
  for (unsigned i = 0; i < sizeof(point.rest); ++i) {
    if (point.rest[i] != point.number % 128) return false;
  }
  return true;
}

void await_top(DSSMApi<Point>& con, int tid) {
  while (con.getTID_topBuf(0) < tid) usleep(1000);
}

void reads_every_sample_in_order() {
  DSSMApi<Point> con("buffered", 2, address);
  CHECK(con.initRemote() && con.open(SSM_READ_BUFFER));
  CHECK(con.createDataCon());
  CHECK(!con.readNewBuf() && !con.readBuf() && !con.readTimeBuf(5));
  CHECK_EQUAL(con.getTID_topBuf(0), -1);
  con.timeId = 99;
  con.readyRingBuf(0.5, 0.0001);  // 6001 slots
  CHECK_EQUAL(con.timeId, -1);

  // What was there before comes as well.
  await_top(con, 9);
  CHECK(con.readBuf(3));
  CHECK_EQUAL(con.data.number, 3);
  CHECK_SAME(con.time, 1003);

  // Fast, where the old one kept one sample of many.
  for (int i = 10; i < 3000; ++i) {
    write_one(i);
    if (i % 100 == 0) usleep(1000);
  }
  await_top(con, 2999);
  con.timeId = 9;
  for (int i = 10; i < 3000; ++i) {
    CHECK(con.readNextBuf());
    CHECK_EQUAL(con.timeId, i);
    CHECK_EQUAL(con.data.number, i);
    CHECK(whole(con.data));
  }
  CHECK(!con.readNextBuf() && !con.readNewBuf());
  CHECK(con.readBackBuf(1000));
  CHECK_EQUAL(con.data.number, 1999);
  CHECK(con.readNextBuf(-9));
  CHECK_EQUAL(con.data.number, 1990);
  CHECK(con.readTimeBuf(1100.5));
  CHECK_EQUAL(con.data.number, 100);
  CHECK(con.readTimeBuf(1e9) && con.data.number == 2999);
  CHECK(con.readTimeBuf(0) && con.data.number == 2999);
  CHECK(con.readLastBuf() && con.data.number == 2999);

  // What is not there leaves everything as it is. The old one returned zeros, or another lap's
  // data.
  CHECK(!con.readBuf(3000) && !con.readTimeBuf(1.0));
  CHECK_EQUAL(con.timeId, 2999);
  CHECK_EQUAL(con.data.number, 2999);

  // The network is still there for who wants to ask.
  CHECK_EQUAL(con.getTID_top(), 2999);
  CHECK(con.readLast());
}

// The stream is older than its ring.
void begins_with_the_oldest_held() {
  DSSMApi<Point> old("old", 2, address), con("old", 2, address);
  CHECK(old.create(1.0, 0.1) && old.createDataCon());  // 13 slots
  for (int i = 0; i < 40; ++i) {
    old.wdata->number = i;
    memset(old.wdata->rest, i, sizeof(old.wdata->rest));
    CHECK(old.write(1000.0 + i));
  }
  while (old.getTID_top() < 39) usleep(1000);
  CHECK(con.open(SSM_READ_BUFFER) && con.createDataCon());
  con.readyRingBuf(5, 0.1);
  await_top(con, 39);
  CHECK(!con.readBuf(27));
  for (int i = 28; i < 40; ++i) {
    CHECK(con.readBuf(i));
    CHECK_EQUAL(con.data.number, i);
    CHECK(whole(con.data));
    CHECK_SAME(con.time, 1000.0 + i);
  }
}

void skips_what_left_its_ring() {
  DSSMApi<Point> con("buffered", 2, address);
  CHECK(con.open(SSM_EXCLUSIVE));
  CHECK(con.UDPcreateDataCon());
  con.readyRingBuf(0.001, 0.0001);  // 13 slots: 12 samples
  await_top(con, 2999);
  CHECK(!con.readBuf(2900));
  con.timeId = 2900;
  CHECK(con.readNextBuf());
  CHECK_EQUAL(con.timeId, 2988);
  CHECK(whole(con.data));
  // Again, with the stream's own life and cycle: as last time.
  con.readyRingBuf();
  CHECK_EQUAL(con.timeId, -1);
  await_top(con, 2999);
  CHECK(con.readNewBuf());
}

void refuses_what_cannot_be() {
  DSSMApi<Point> con("buffered", 2, address);
  CHECK(con.open() && con.createDataCon());
  catch_stderr();
  con.readyRingBuf(0.1, 1.0);  // was exit()
  CHECK_TEXT(caught_stderr(), "life");
  CHECK(!con.readLastBuf());
  con.readyRingBuf(512, 0.1);
  CHECK_EQUAL(con.getTID_topBuf(0) >= -1, 1);
  await_top(con, 2999);
  DSSMApi<Point> by_default("buffered", 2, address);
  CHECK(by_default.open() && by_default.createDataCon());
  by_default.readyRingBuf();  // was uninitialised memory
  await_top(by_default, 2999);
  CHECK(by_default.readBuf(2990));
}

// The thread ends with its object, at any moment.
void ends_with_its_object() {
  for (int i = 0; i < 20; ++i) {
    DSSMApi<Point> con("buffered", 2, address);
    CHECK(con.open() && con.createDataCon());
    con.readyRingBuf(0.1, 0.01);
    if (i % 2 == 0) {
      while (!con.readNewBuf()) usleep(100);
    }
    if (i % 3 == 0) con.terminate();
  }
}

void a_child_reads_on() {
  DSSMApi<Point> con("buffered", 2, address);
  CHECK(con.open() && con.createDataCon());
  con.readyRingBuf(1, 0.01);
  await_top(con, 2999);
  fflush(stdout);
  const pid_t child = fork();
  if (child == 0) {
    const bool good = con.readLastBuf() && con.data.number == 2999;
#ifdef __SANITIZE_ADDRESS__
    _exit(good ? 0 : 1);  // what the parent's thread had would count as lost
#endif
    exit(good ? 0 : 1);
  }
  int status = -1;
  waitpid(child, &status, 0);
  CHECK_EQUAL(status, 0);
  write_one(3000);
  await_top(con, 3000);
  CHECK(con.readNewBuf() && con.data.number == 3000);
}

DSSMApi<Point> global("buffered", 2);

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  address = argv[2];
  DSSMApi<Point> source("buffered", 2, address);
  writer = &source;
  CHECK(source.initRemote() && source.create(1.0, 0.0001) && source.createDataCon());
  for (int i = 0; i < 10; ++i) write_one(i);
  reads_every_sample_in_order();
  begins_with_the_oldest_held();
  skips_what_left_its_ring();
  refuses_what_cannot_be();
  ends_with_its_object();
  a_child_reads_on();
  global.setIpAddress(address);
  CHECK(global.open() && global.createDataCon());
  global.readyRingBuf();  // still collecting when main() ends
  await_top(global, 3000);
  return check_result();
}
