// SPDX-License-Identifier: Apache-2.0
//
// The remote interface as programs for the old DSSM use it: one writer, one reader, and what the
// old one got wrong. Arguments: FOLDER ADDRESS, where ADDRESS is the dssmd that initSSM() finds,
// too.
#include <ssm.hpp>

#include "check.h"
#include "dssm.hpp"

namespace {

struct Point {
  int number;
  double x, y;
};

struct Mounting {
  double height;
  int serial;
};

struct Wide {
  char text[100000];
};

const char* address;

void writes(DSSMApi<Point, Mounting>& con, int number) {
  con.wdata->number = number;
  con.wdata->x = 0.5 * number;
  con.wdata->y = -1;
  CHECK(con.write(1000.0 + number));
}

// Written samples arrive a moment later: waits for the one with this number.
void await(DSSMApi<Point, Mounting>& con, int number) {
  while (!con.readLast() || con.data.number != number) usleep(1000);
}

void before_anything() {
  DSSMApi<Point, Mounting> con("remote", 1, address);
  CHECK_EQUAL(con.timeId, -1);
  CHECK_SAME(con.time, 0);
  CHECK(!con.isOpen());
  CHECK(!con.createDataCon());
  CHECK(!con.read() && !con.readNew() && !con.readNext(1) && !con.readTime(5) && !con.readLast());
  CHECK(!con.write() && !con.isUpdate());
  CHECK(!con.getProperty() && !con.setProperty());
  CHECK_EQUAL(con.getTID_top(), -1);
  CHECK_EQUAL(con.getTID_bottom(0), -1);
  CHECK_EQUAL(con.getTID(0, 5), -1);
  CHECK_EQUAL(con.getTID_topBuf(0), -1);
  CHECK(con.release() && con.terminate());
  CHECK(strcmp(con.getStreamName(), "remote") == 0 && con.getStreamId() == 1);
  CHECK(con.getSSMId() == 0);
  CHECK(con.getData() == &con.data && con.PConnector::data() == &con.data);
  CHECK_EQUAL(con.dataSize(), sizeof(Point));
  CHECK_EQUAL(con.sharedSize(), sizeof(Point));
  CHECK_EQUAL(con.propertySize(), sizeof(Mounting));
  CHECK(reinterpret_cast<char*>(con.wdata) == static_cast<char*>(con.fulldata) + sizeof(ssmTimeT));
  timespec t = {3, 500000000};
  CHECK_SAME(con.timettof(t), 3.5);
  CHECK(PConnector::getRealTime() > 1.6e9 &&
        PConnector::getRealTime() - gettimeSSM_real() < 1.0);  // was half an hour off
}

void refuses_bad_arguments() {
  DSSMApi<Point, Mounting> con("remote", 1, address);
  CHECK(con.initRemote());
  catch_stderr();
  CHECK(!con.create(0, 0.1));
  CHECK_TEXT(caught_stderr(), "life");
  catch_stderr();
  CHECK(!con.create("a name that is much too long for it", 1, 1, 0.1));
  CHECK_TEXT(caught_stderr(), "31 bytes");
  catch_stderr();
  CHECK(!con.create("remote", -1, 1, 0.1));
  CHECK_TEXT(caught_stderr(), "id");
  catch_stderr();
  CHECK(!con.open("a name that is much too long for it", 1, SSM_READ));
  CHECK_TEXT(caught_stderr(), "at most 31");
  PConnector plain("remote", 1, address);
  catch_stderr();
  CHECK(!plain.create(1, 0.1) && !plain.open());
  CHECK_TEXT(caught_stderr(), "data buffer");
}

void writes_and_reads() {
  DSSMApi<Point, Mounting> writer("remote", 1, address), reader("remote", 1, address);
  CHECK(writer.initRemote());
  CHECK(writer.create(1.0, 0.1));  // 13 slots
  CHECK(writer.isOpen());
  writer.property.height = 1.25;
  writer.property.serial = 77;
  CHECK(writer.setProperty());
  writer.setConnectType(TCP_CONNECT);
  CHECK(writer.createDataCon());

  reader.setConnectType(UDP_CONNECT);
  CHECK(reader.initDSSM());
  CHECK(reader.open(SSM_READ));
  CHECK(reader.getProperty());
  CHECK_SAME(reader.property.height, 1.25);
  CHECK_EQUAL(reader.property.serial, 77);
  CHECK(!reader.read());  // before createDataCon()
  CHECK(reader.UDPcreateDataCon());

  // An empty stream. The old one said true, or lost its place in the answers.
  CHECK(!reader.read() && !reader.readNew() && !reader.readTime(5) && !reader.readNext(1));
  CHECK_EQUAL(reader.timeId, -1);
  CHECK_EQUAL(reader.getTID_top(), -1);
  CHECK_EQUAL(reader.getTID_bottom(), -1);
  CHECK_EQUAL(reader.getTID(0, 5), -3);
  CHECK(!reader.isUpdate());

  writes(writer, 0);
  CHECK_EQUAL(writer.timeId, -1);
  CHECK_SAME(writer.time, 1000);
  await(reader, 0);
  CHECK_EQUAL(reader.timeId, 0);
  CHECK(!reader.readNew());  // was true without anything new
  for (int i = 1; i < 20; ++i) writes(writer, i);
  await(reader, 19);
  CHECK_EQUAL(reader.timeId, 19);
  CHECK_SAME(reader.time, 1019);
  CHECK_SAME(reader.data.x, 9.5);

  CHECK_EQUAL(reader.getTID_top(), 19);
  CHECK_EQUAL(reader.getTID_top(0), 19);
  CHECK_EQUAL(reader.getTID_bottom(), 8);
  CHECK_EQUAL(reader.getTID(0, 1012.5), 12);
  CHECK_EQUAL(reader.getTID(0, 1012), 11);  // strictly before, as getTID() has it
  CHECK_EQUAL(reader.getTID(0, 1), -2);
  CHECK_EQUAL(reader.timeId, 19);  // asking for tids changes nothing

  CHECK(reader.read(12));
  CHECK_EQUAL(reader.data.number, 12);
  CHECK(reader.isUpdate());
  CHECK(reader.readNext(1));
  CHECK_EQUAL(reader.data.number, 13);
  CHECK(reader.readNext(3));
  CHECK_EQUAL(reader.data.number, 16);
  CHECK(reader.readNext());
  CHECK_EQUAL(reader.data.number, 17);
  CHECK(!reader.readNext(5));  // was true, with the sample before
  CHECK(reader.readBack(2));
  CHECK_EQUAL(reader.data.number, 15);
  CHECK(!reader.readBack(100));
  CHECK(reader.readTime(1010.5));
  CHECK_EQUAL(reader.data.number, 10);
  CHECK_SAME(reader.time, 1010);
  CHECK(reader.readTime(1010));
  CHECK_EQUAL(reader.data.number, 10);
  CHECK(reader.readTime(5000) && reader.data.number == 19);
  CHECK(reader.readTime(0) && reader.data.number == 19);
  CHECK(reader.read(3, READ_NEXT) == false);
  CHECK(reader.read(11));
  CHECK(reader.read(2, READ_NEXT) && reader.data.number == 13);

  // Errors leave everything as it was.
  CHECK(!reader.read(500) && !reader.read(3) && !reader.readTime(1.0));
  CHECK_EQUAL(reader.timeId, 13);
  CHECK_EQUAL(reader.data.number, 13);
  CHECK_SAME(reader.time, 1013);

  // A sample that left the ring: the oldest in its place, and a word about it.
  reader.timeId = 2;
  catch_stderr();
  CHECK(reader.readNext(1));
  CHECK_TEXT(caught_stderr(), "3 -> 8");
  CHECK_EQUAL(reader.data.number, 8);

  // Creating joins, and 0 means "as last time".
  CHECK(writer.create());
  CHECK(writer.createDataCon());
  writes(writer, 20);
  await(reader, 20);
  CHECK_EQUAL(reader.timeId, 20);
  CHECK(reader.terminate() && reader.release() && writer.terminate());
  CHECK(!reader.isOpen() && !reader.readLast() && !writer.write());
}

void refuses_other_sizes() {
  DSSMApi<Wide> wide("remote", 1, address);
  CHECK(wide.initRemote());
  catch_stderr();
  CHECK(!wide.open());
  const char* said = caught_stderr();
  CHECK_TEXT(said, "24 bytes");
  CHECK_TEXT(said, "100000");
  CHECK(!wide.createDataCon());
  catch_stderr();
  CHECK(!wide.create(1.0, 0.1));
  CHECK_TEXT(caught_stderr(), "24 bytes");
  DSSMApi<Point, double> other_property("remote", 1, address);
  CHECK(other_property.open());
  catch_stderr();
  CHECK(!other_property.getProperty());
  CHECK_TEXT(caught_stderr(), "16 bytes");
}

void carries_large_samples() {
  DSSMApi<Wide>* writer = new DSSMApi<Wide>("wide", 0, address);
  DSSMApi<Wide>* reader = new DSSMApi<Wide>("wide", 0, address);
  CHECK(writer->initRemote() && writer->create(1.0, 0.1) && writer->createDataCon());
  CHECK(reader->initRemote() && reader->open() && reader->createDataCon());
  for (int i = 0; i < 3; ++i) {
    memset(writer->wdata->text, 'a' + i, sizeof(writer->wdata->text));
    CHECK(writer->write(i + 1));
    while (!reader->readNew()) usleep(1000);
    CHECK_EQUAL(reader->timeId, i);
    CHECK(memcmp(&reader->data, writer->wdata, sizeof(Wide)) == 0);  // was 65,536 bytes of it
  }
  PConnector* base = writer;
  delete base;
  delete reader;
}

// Events: samples that have only a time.
void carries_samples_of_size_0() {
  double sent[1] = {0};  // room for the time, and nothing after it
  char received = 'x';
  PConnector writer("events", 0, address), reader("events", 0, address);
  writer.setBuffer(&received, 0, 0, 0, sent);
  reader.setBuffer(&received, 0, 0, 0, 0);
  CHECK(writer.initRemote() && writer.create(1.0, 0.1) && writer.createDataCon());
  CHECK(reader.initRemote() && reader.open() && reader.createDataCon());
  if (!reader.isOpen()) return;
  CHECK(!reader.readLast());
  for (int i = 0; i < 3; ++i) {
    CHECK(writer.write(1000.0 + i));
    while (!reader.readNew()) usleep(1000);
    CHECK_EQUAL(reader.timeId, i);
    CHECK_SAME(reader.time, 1000.0 + i);
  }
  CHECK(reader.readTime(1001.5));
  CHECK_EQUAL(reader.timeId, 1);
  CHECK_EQUAL(received, 'x');

  DSSMApi<char> other("events", 0, address);
  catch_stderr();
  CHECK(!other.open());
  CHECK_TEXT(caught_stderr(), "has 0 bytes per sample, this program's type 1");

  SSMApiBase local;
  local.setBuffer(&received, 0, 0, 0);
  CHECK(initSSM());
  CHECK(local.open("events", 0));
  CHECK(local.readLast());
  CHECK_SAME(local.time, 1002);
  CHECK(endSSM());
}

// The same stream, seen from this PC and over the network.
void is_the_same_stream() {
  CHECK(initSSM());
  SSMApi<Point, Mounting> local("remote", 1);
  CHECK(local.open());
  CHECK(local.getProperty());
  CHECK_EQUAL(local.property.serial, 77);
  DSSMApi<Point, Mounting> remote("remote", 1, address);
  CHECK(remote.initRemote() && remote.open(SSM_WRITE) && remote.createDataCon());
  writes(remote, 21);
  await(remote, 21);
  CHECK(local.readLast());
  CHECK_EQUAL(local.timeId, remote.timeId);
  CHECK_EQUAL(local.data.number, 21);
  local.data.number = 22;
  CHECK(local.write(1022));
  CHECK(remote.readNew());
  CHECK_EQUAL(remote.data.number, 22);
  CHECK_SAME(remote.time, 1022);

  DSSMApi<Point> unknown("remote", 1, "192.0.2.1");
  catch_stderr();
  unknown.setOffset(100);
  CHECK_TEXT(caught_stderr(), "192.0.2.1");
  CHECK_SAME(gettimeOffset(), 0);
  remote.setOffset(100);
  CHECK_SAME(gettimeOffset(), 100);
  inittimeSSM();
  CHECK(endSSM());
}

void waits_can_be_limited() {
  setenv("DSSM_CONNECT_TIMEOUT", "0.05", 1);
  DSSMApi<Point> none("none", 0, address);
  CHECK(none.initRemote());
  catch_stderr();
  CHECK(!none.open());
  CHECK_TEXT(caught_stderr(), "none");
  setenv("DSSM_CONNECT_TIMEOUT", "0", 1);
  DSSMApi<Point> nowhere("none", 0, "127.0.0.1:1");
  catch_stderr();
  CHECK(!nowhere.initRemote());
  CHECK_TEXT(caught_stderr(), "127.0.0.1:1");
  DSSMApi<Point> nonsense("none", 0, "127.0.0.1:many");
  catch_stderr();
  CHECK(!nonsense.initRemote());
  CHECK_TEXT(caught_stderr(), "many");
  unsetenv("DSSM_CONNECT_TIMEOUT");
}

// Anything as T and P, as long as it can be made and assigned.
struct alignas(32) Aligned {
  char bytes[32];
};

void takes_other_types() {
  DSSMApi<Aligned> aligned("aligned", 0, address);
  CHECK_EQUAL(reinterpret_cast<unsigned long>(aligned.wdata) % 32, 0);
  DSSMApi<int> number("number", 0, address);
  CHECK(number.initRemote() && number.create(1, 0.1) && number.createDataCon());
  *number.wdata = 5;
  CHECK(number.write());
  while (!number.readNew()) usleep(1000);
  CHECK_EQUAL(number.data, 5);
  DSSMApiWithProp<Point, Mounting> with("number", 0, address);
  with.br_data.serial = 1;
  CHECK(with.pbr_data == &with.br_data);
  CHECK_EQUAL(with.propertySize(), sizeof(DSSMDummy));
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  address = argv[2];
  before_anything();
  refuses_bad_arguments();
  writes_and_reads();
  refuses_other_sizes();
  carries_large_samples();
  carries_samples_of_size_0();
  is_the_same_stream();
  waits_can_be_limited();
  takes_other_types();
  return check_result();
}
