// SPDX-License-Identifier: Apache-2.0
//
// The C++ interface, member by member, as the old headers offer it. Compiled in every dialect from
// C++98 on.
#include <libssm.h>
#include <ssmtype/bumper.h>
#include <ssmtype/ultrasonic.h>

#include <ssm.hpp>
#include <ssmp.hpp>

#include "check.h"

namespace {

struct Odometry {
  double x, y, theta, v, w;
};
struct Mount {
  double x, y;
  int serial;
};

void initial_state() {
  SSMApiBase base;
  CHECK(!base.isOpen());
  CHECK(!base.isUpdate());
  CHECK(strcmp(base.getStreamName(), "") == 0);
  CHECK_EQUAL(base.getStreamId(), 0);
  CHECK(base.getSSMId() == 0);
  CHECK_EQUAL(base.timeId, -1);
  CHECK_SAME(base.time, 0);
  CHECK(base.data() == NULL && base.dataSize() == 0);
  CHECK(base.property() == NULL && base.propertySize() == 0);
  CHECK_EQUAL(base.sharedSize(), 0);
  CHECK(base.close() && base.release());  // always true

  SSMApi<Odometry, Mount> api("odo", 3);
  CHECK(strcmp(api.getStreamName(), "odo") == 0);
  CHECK_EQUAL(api.getStreamId(), 3);
  CHECK(api.SSMApiBase::data() == &api.data && api.dataSize() == sizeof(Odometry));
  CHECK(api.SSMApiBase::property() == &api.property && api.propertySize() == sizeof(Mount));
  CHECK_EQUAL(api.sharedSize(), static_cast<long>(sizeof(Odometry)));
  catch_stderr();
  CHECK(strcmp(api.getSensorName(), "odo") == 0);
  CHECK_EQUAL(api.getSensorId(), 3);
  CHECK_TEXT(caught_stderr(), "getStreamName");
  CHECK_EQUAL(sizeof(SSMDummy), 1);

  Bumper bumper = {1, 2.5};
  Ultrasonic ultrasonic = {1, 2, 3, 4, 5};
  CHECK(bumper.state == 1 && ultrasonic.right > 3);
}

void without_buffer() {
  SSMApiBase base("nobuffer", 0);
  base.setVerbose(false);
  catch_stderr();
  const bool created = base.create(1, 0.1), opened = base.open(), waited = base.openWait();
  const char* const text = caught_stderr();  // also when not verbose
  CHECK(!created && !opened && !waited);
  CHECK_TEXT(text, "SSM::create()");
  CHECK_TEXT(text, "SSM::open()");
  CHECK(!base.setProperty() && !base.getProperty());
}

void failures_and_words() {
  SSMApi<Odometry> api("words", 5);
  CHECK(!api.write() && !api.read() && !api.readLast() && !api.readNew() && !api.readNext() &&
        !api.readBack() && !api.readTime(1.0));
  catch_stderr();
  const bool opened = api.open();
  CHECK_TEXT(caught_stderr(), "SSM::open() : cannot open 'words', id = 5");
  CHECK(!opened);
  catch_stderr();
  const bool created = api.create(-1, 0.1);
  CHECK_TEXT(caught_stderr(), "SSM::create() : cannot create 'words', id = 5");
  CHECK(!created && !api.isOpen());
  api.setVerbose(false);
  catch_stderr();
  CHECK(!api.open());
  CHECK(strcmp(caught_stderr(), "") == 0);
  catch_stderr();
  CHECK(!api.create("otherwords", 6, -1, 0.1));
  caught_stderr();
  CHECK(strcmp(api.getStreamName(), "otherwords") == 0);  // stored although it failed
  CHECK_EQUAL(api.getStreamId(), 6);
  CHECK(!api.open("thirdwords", 7));
  CHECK(strcmp(api.getStreamName(), "thirdwords") == 0 && api.getStreamId() == 7);
}

void writing_and_reading() {
  SSMApi<Odometry, Mount> writer("drive", 1), reader("drive", 1);
  CHECK(writer.create(1.0, 0.1));
  CHECK(writer.isOpen() && writer.getSSMId() != 0);
  CHECK(reader.open());
  CHECK(!reader.isUpdate() && !reader.readNew() && !reader.readLast() && !reader.readNext());
  CHECK_EQUAL(reader.timeId, -1);

  for (int i = 0; i < 3; ++i) {
    writer.data.x = i;
    CHECK(writer.write(10.0 + i));
    CHECK_EQUAL(writer.timeId, i);
    CHECK_SAME(writer.time, 10.0 + i);
  }
  CHECK(reader.isUpdate());
  CHECK(reader.readNext());  // nothing read yet: the newest
  CHECK_EQUAL(reader.timeId, 2);
  CHECK_SAME(reader.data.x, 2);
  CHECK_SAME(reader.time, 12.0);
  CHECK(!reader.isUpdate() && !reader.readNew() && !reader.readNext());
  CHECK(reader.readLast());  // true although seen
  CHECK(reader.readBack());
  CHECK_EQUAL(reader.timeId, 1);
  CHECK_SAME(reader.data.x, 1);
  CHECK(!reader.readBack(2));
  CHECK(reader.readNext(0));
  CHECK_EQUAL(reader.timeId, 1);
  CHECK(reader.readNext());
  CHECK_EQUAL(reader.timeId, 2);
  CHECK(reader.readNext(-2));
  CHECK_EQUAL(reader.timeId, 0);
  CHECK(!reader.readNext(7));
  CHECK_EQUAL(reader.timeId, 0);
  CHECK(reader.readNew());
  CHECK_EQUAL(reader.timeId, 2);
  CHECK(reader.read(1) && !reader.read(3));
  CHECK_EQUAL(reader.timeId, 1);  // a false leaves all as it was
  CHECK_SAME(reader.data.x, 1);
  CHECK(reader.readTime(11.5));
  CHECK_EQUAL(reader.timeId, 1);
  CHECK_SAME(reader.time, 11.0);
  CHECK(reader.readTime(99.0) && reader.timeId == 2);
  CHECK(reader.readTime(0) && reader.timeId == 2);
  CHECK(!reader.readTime(9.5));
  CHECK_EQUAL(reader.timeId, 2);
  CHECK_SAME(reader.time, 12.0);

  for (int i = 3; i < 30; ++i) writer.write(10.0 + i);  // laps the 13 slots
  catch_stderr();
  CHECK(reader.readNext());
  CHECK_TEXT(caught_stderr(), "SSM::readNext() : skipping read data  'drive', id = 1 TID: 3 -> 18");
  CHECK_EQUAL(reader.timeId, 18);
  CHECK_EQUAL(getTID_bottom(reader.getSSMId()), 18);

  const double before = gettimeSSM();
  CHECK(writer.write());  // the default time is now
  CHECK(writer.time >= before && writer.time <= gettimeSSM());

  CHECK(reader.close());
  CHECK(!reader.isOpen() && !reader.readLast());
  CHECK_EQUAL(reader.timeId, 18);
  CHECK(writer.release() && writer.release());
  CHECK(!writer.write(1.0));
  CHECK(writer.create(1.0, 0.1) && writer.write(50.0));
  CHECK_EQUAL(writer.timeId, 31);  // the stream lived on
  reader.setVerbose(false);
  CHECK(reader.open("drive", 1, SSM_EXCLUSIVE));
  CHECK_EQUAL(reader.timeId, 18);  // open() does not reset it
  CHECK(reader.readNext() && reader.timeId == 20);
}

void blocking() {
  SSMApi<int> writer("block", 0), reader("block", 0);
  writer.create(1.0, 0.1);
  reader.open();
  reader.setBlocking(true);
  double before = gettimeSSM_real();
  CHECK(!reader.readNext());  // waits a second for tid 0
  CHECK(gettimeSSM_real() - before > 0.9);
  writer.data = 7;
  writer.write(1.0);
  CHECK(reader.readNext() && reader.data == 7);
  before = gettimeSSM_real();
  CHECK(!reader.readNew());
  CHECK(gettimeSSM_real() - before > 0.9);
  writer.write(2.0);
  CHECK(reader.readNew() && reader.timeId == 1);
}

void open_wait() {
  SSMApi<int> api("later", 0);
  double before = gettimeSSM_real();
  catch_stderr();
  const int waited = api.openWait(0.2);
  const char* const text = caught_stderr();
  CHECK_TEXT(text, "SSM::openWait() : wait for stream 'later', id = 0");
  CHECK_TEXT(text, "SSM::open() : cannot open 'later', id = 0");
  CHECK_EQUAL(waited, 0);
  CHECK(gettimeSSM_real() - before > 0.19);
  CHECK(settimeSSM_speed(100.0) == 1);  // real time, whatever the clock does
  api.setVerbose(false);
  before = gettimeSSM_real();
  CHECK(!api.openWait(0.2));
  CHECK(gettimeSSM_real() - before > 0.19);
  inittimeSSM();
  SSMApi<int> writer("later", 0);
  writer.create(1.0, 0.1);
  CHECK_EQUAL(api.openWait("later", 0, 0.0, SSM_READ), 1);
}

void properties() {
  SSMApi<int, Mount> writer("propapi", 0), reader("propapi", 0);
  SSMApi<int, double> other("propapi", 0);
  SSMApi<int> plain("propapi", 0);
  CHECK(!writer.setProperty() && !reader.getProperty());  // no such stream
  writer.create(1.0, 0.1);
  CHECK(!reader.getProperty());  // none set
  memset(&writer.property, 0, sizeof(writer.property));
  writer.property.serial = 42;
  CHECK(writer.setProperty());
  CHECK(reader.getProperty());  // needs no open
  CHECK_EQUAL(reader.property.serial, 42);
  other.property = 3;
  catch_stderr();
  const bool got = other.getProperty();  // would overrun, or fill half
  CHECK_TEXT(caught_stderr(), "24 bytes");
  CHECK(!got);
  CHECK_SAME(other.property, 3);
  CHECK(plain.setProperty() && plain.getProperty());  // one meaningless byte
}

void other_sizes() {
  struct Guarded {
    SSMApi<int> api;
    char behind[8192];
  };
  static Guarded guarded;
  memset(guarded.behind, 'g', sizeof(guarded.behind));
  SSMApi<char[4096]> big("sizes", 0);
  SSMApi<char[4]> small("sizes", 1);
  CHECK(big.create(1.0, 0.1) && big.write(1.0));
  CHECK(small.create(1.0, 0.1) && small.write(1.0));
  catch_stderr();
  const bool opened_big = guarded.api.open("sizes", 0);
  CHECK_TEXT(caught_stderr(), "has 4096 bytes per sample, this program's type 4");
  CHECK(!opened_big && !guarded.api.isOpen());
  SSMApi<double> wide("sizes", 1);
  catch_stderr();
  const bool opened_small = wide.open();
  CHECK_TEXT(caught_stderr(), "has 4 bytes per sample, this program's type 8");
  CHECK(!opened_small);
  catch_stderr();
  const bool created = guarded.api.create("sizes", 0, 1.0, 0.1);
  CHECK_TEXT(caught_stderr(), "4096");
  CHECK(!created);
  for (size_t i = 0; i < sizeof(guarded.behind); ++i) CHECK(guarded.behind[i] == 'g');
}

// A generic tool: no type, buffers as large as the stream says.
void plain_base() {
  SSMApi<Odometry, Mount> writer("generic", 2);
  writer.create(1.0, 0.1);
  writer.setProperty();
  writer.data.theta = 0.75;
  writer.write(3.0);
  size_t size = 0, property_size = 0;
  CHECK_EQUAL(getSSM_info("generic", 2, &size, NULL, NULL, &property_size),
              static_cast<long>(sizeof(Odometry)));
  SSMApiBase base("generic", 2);
  void *data = malloc(size), *property = malloc(property_size);
  base.setBuffer(data, size, property, property_size);
  CHECK(base.open() && base.readLast() && base.getProperty());
  CHECK_SAME(static_cast<Odometry*>(base.data())->theta, 0.75);
  Odometry half;
  base.setDataBuffer(&half, sizeof(half) / 2);  // changed under way: asked again
  catch_stderr();
  const bool read = base.readLast();
  CHECK_TEXT(caught_stderr(), "this program's type 20");
  CHECK(!read);
  base.setPropertyBuffer(property, property_size);
  base.addInfo("x", 1, 8080);
  base.getInfo();
  free(data);
  free(property);
}

// With the address of a buffer, as a generic tool has one.
void size_zero() {
  char buffer = 'u';
  SSMApiBase writer("size_zero", 0), reader("size_zero", 0);
  writer.setBuffer(&buffer, 0, NULL, 0);
  reader.setBuffer(&buffer, 0, NULL, 0);
  CHECK(writer.create(1.0, 0.1) && reader.open() && reader.openWait(1.0));
  CHECK(writer.write(12.5) && writer.write(13.5));
  CHECK(reader.readTime(12.5) && reader.timeId == 0);
  CHECK(reader.readNext() && reader.timeId == 1);
  CHECK_SAME(reader.time, 13.5);
  CHECK(buffer == 'u');
  SSMApi<char> wrong("size_zero", 0);
  catch_stderr();
  const bool opened = wrong.open();
  CHECK_TEXT(caught_stderr(), "has 0 bytes per sample, this program's type 1");
  CHECK(!opened);
}

void pack(void* ssmp, const void* data, void*) { memcpy(ssmp, data, 12); }
void unpack(const void* ssmp, void* data, void* user) {
  memcpy(data, ssmp, 12);
  ++*static_cast<int*>(user);
}

void variable_size() {
  SSMPApi<int, Mount> writer("varsize", 0);
  SSMApiP<int> reader("varsize", 0);
  CHECK(writer.data == NULL && writer.writeData == NULL && writer.userData == NULL);
  catch_stderr();
  CHECK(!writer.create(1.0, 0.1));
  caught_stderr();
  CHECK(writer.alloc(12) && reader.alloc(12) && reader.alloc(12));
  CHECK(writer.create(1.0, 0.1) && reader.open());
  for (int i = 0; i < 3; ++i) writer.data[i] = 10 + i;
  CHECK(writer.write(1.0) && reader.read());  // plain copies
  CHECK_EQUAL(reader.data[2], 12);
  int count = 0;
  writer.writeData = pack;
  reader.readData = unpack;
  reader.userData = &count;
  writer.data[0] = 99;
  CHECK(writer.write(2.0) && writer.timeId == 1);
  CHECK(reader.readNew() && reader.timeId == 1);
  CHECK_EQUAL(reader.data[0], 99);
  CHECK_EQUAL(count, 1);
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  initial_state();
  without_buffer();
  CHECK_EQUAL(initSSM(), 1);
  failures_and_words();
  writing_and_reading();
  blocking();
  open_wait();
  properties();
  other_sizes();
  plain_base();
  size_zero();
  variable_size();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
