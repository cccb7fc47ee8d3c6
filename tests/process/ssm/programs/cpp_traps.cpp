// SPDX-License-Identifier: Apache-2.0
//
// What real programs do with the C++ interface, one function per trap, in the words of old
// programs. Signals, several processes and their ends have programs of their own.
#include <list>
#include <ssm.hpp>
#include <stdexcept>
#include <string>
#include <vector>

#include "check.h"

// Names that programs define for themselves; a header that took one would not compile with this.
#define PI 3.14159
#define SNAME_SCAN "scan"
#define SID_SCAN 1
static bool gShutOff = false;
static void ctrlC(int) { gShutOff = true; }
static void setSigInt() {}
struct node {
  int a;
};
struct edge {
  int b;
};
static char get_unit(double) { return ' '; }

typedef unsigned char image[640 * 480 * 3];
struct ImageStruct {
  int width, height;
  unsigned char pixels[7000000];
};
struct Pose {
  double x, y;
};

// A static object: made before main() and before initSSM().
static SSMApi<Pose> static_api("static", 1);

namespace {

template <typename T>
void write_and_read(const char* name, const T& value) {
  SSMApi<T> writer(name, 0), reader(name, 0);
  CHECK(writer.create(0.2, 0.1) && reader.open());
  memcpy(&writer.data, &value, sizeof(T));
  CHECK(writer.write(1.0) && reader.readNew());
  CHECK(memcmp(&reader.data, &value, sizeof(T)) == 0);
}

void anything_as_type() {
  write_and_read<int>("t_int", 5);
  write_and_read<double>("t_double", 2.5);
  write_and_read<bool>("t_bool", true);
  Pose pose = {1, 2};
  write_and_read<Pose>("t_pose", pose);

  static SSMApi<image> writer("t_image", 0), reader("t_image", 0);
  CHECK(writer.create(0.3, 0.1) && reader.open());
  for (size_t i = 0; i < sizeof(image); ++i) writer.data[i] = static_cast<unsigned char>(i * 7);
  CHECK(writer.write(1.0) && reader.readNew());
  CHECK(memcmp(reader.data, writer.data, sizeof(image)) == 0);
}

void huge_on_the_stack() {
  SSMApi<ImageStruct> api("t_huge", 0);  // 7 MB of the stack's 8: no second copy inside
  CHECK(sizeof(api) < sizeof(ImageStruct) + 512);
  CHECK(api.create(0.2, 0.1));
  api.data.width = 640;
  CHECK(api.write(1.0));
  api.data.width = 0;
  CHECK(api.readLast() && api.data.width == 640);
}

// A scan that owns memory, and the wrapper that real programs write around it.
class Scan {
 public:
  Scan() : points(), count(0) {}
  void alloc(size_t n) { points.resize(n); }
  std::vector<double> points;
  size_t count;
};

struct ScanProperty {
  int max;
};

class ScanApi : public SSMApi<Scan, ScanProperty> {
 public:
  ScanApi(const char* name, int id) : SSMApi<Scan, ScanProperty>(name, id), calls(0) {}
  bool write(ssmTimeT now = gettimeSSM()) {
    return (timeId = writeSSMP(ssmId, &data, now, writing, NULL)) >= 0 ? (time = now, true) : false;
  }
  bool read(int tid = -1) {
    ++calls;
    const SSM_tid got = readSSMP(ssmId, &data, &time, tid, reading, NULL);
    if (got < 0) return false;
    timeId = got;
    return true;
  }
  bool readTime(ssmTimeT when) {
    const SSM_tid got = readSSMP_time(ssmId, &data, when, &(this->time), reading, NULL);
    if (got < 0) return false;
    timeId = got;
    return true;
  }
  // Without the 8 bytes of the count that writing() puts in front: as found in the wild.
  size_t sharedSize() { return data.points.size() * sizeof(double); }
  int calls;

 private:
  static void writing(void* ssmp, const void* from, void*) {
    const Scan& scan = *static_cast<const Scan*>(from);
    memcpy(ssmp, &scan.count, sizeof(size_t));
    memcpy(static_cast<char*>(ssmp) + sizeof(size_t), &scan.points[0], scan.count * sizeof(double));
  }
  static void reading(const void* ssmp, void* to, void*) {
    Scan& scan = *static_cast<Scan*>(to);
    size_t count = 0;
    memcpy(&count, ssmp, sizeof(size_t));
    if (count > scan.points.size()) throw std::runtime_error("scan does not fit");
    scan.count = count;
    memcpy(&scan.points[0], static_cast<const char*>(ssmp) + sizeof(size_t),
           count * sizeof(double));
  }
};

void subclasses_with_callbacks() {
  ScanApi writer(SNAME_SCAN, SID_SCAN), reader(SNAME_SCAN, SID_SCAN);
  writer.data.alloc(100);
  CHECK(writer.create(1.0, 0.1));  // asks sharedSize() now
  size_t size = 0;
  getSSM_info(SNAME_SCAN, SID_SCAN, &size, NULL, NULL, NULL);
  CHECK_EQUAL(size, 800);
  CHECK(reader.open());  // before it knows the size: its sharedSize() is 0 yet
  reader.data.alloc(100);

  for (int n = 0; n < 40; ++n) {  // full scans: each goes 8 bytes past its slot, three laps long
    writer.data.count = 100;
    for (size_t i = 0; i < 100; ++i) writer.data.points[i] = n + 0.001 * static_cast<double>(i);
    CHECK(writer.write(100.0 + n) && writer.timeId == n);
    for (int tid = getTID_bottom(reader.getSSMId()); tid <= n; ++tid) {
      CHECK(reader.read(tid) && reader.timeId == tid && reader.data.count == 100);
      CHECK_SAME(reader.time, 100.0 + tid);
      CHECK_SAME(reader.data.points[99], tid + 0.001 * 99);
    }
  }
  reader.calls = 0;
  CHECK(reader.readLast() && reader.readBack() && reader.readNext());
  CHECK(!reader.readNew());
  writer.write(200.0);
  CHECK(reader.readNew());
  CHECK_EQUAL(reader.calls, 4);  // through the overridden read()
  CHECK(reader.readTime(139.5));
  CHECK_EQUAL(reader.timeId, 39);
}

void exceptions_from_callbacks() {
  ScanApi writer("throwing", 0), reader("throwing", 0);
  writer.data.alloc(50);
  writer.create(0.4, 0.1);
  reader.data.alloc(10);
  reader.open();
  writer.data.count = 40;
  writer.write(1.0);
  for (int i = 0; i < 100; ++i) {
    std::string what;
    try {
      reader.readLast();
    } catch (const std::runtime_error& error) {
      what = error.what();
    }
    CHECK(what == "scan does not fit");
    what = "";
    try {
      reader.readTime(1.5);
    } catch (const std::runtime_error& error) {
      what = error.what();
    }
    CHECK(what == "scan does not fit");
  }
  CHECK_EQUAL(reader.timeId, -1);
  writer.data.count = 5;
  CHECK(writer.write(2.0) && reader.readLast() && reader.data.count == 5);
}

void throw_half_way(void* ssmp, const void*, void*) {
  memset(ssmp, 0xee, 4);
  throw 7;
}

void exceptions_while_writing() {
  SSMApi<int> api("throwwrite", 0);
  api.create(0.4, 0.1);
  api.data = 1;
  api.write(1.0);
  for (int i = 0; i < 20; ++i) {
    int caught = 0;
    try {
      writeSSMP(api.getSSMId(), &api.data, 2.0, throw_half_way, NULL);
    } catch (int thrown) {
      caught = thrown;
    }
    CHECK_EQUAL(caught, 7);
  }
  CHECK_EQUAL(getTID_top(api.getSSMId()), 0);  // nobody sees the half sample
  CHECK(api.readLast() && api.data == 1);
  CHECK(api.write(3.0) && api.timeId == 1);  // and the stream is not blocked
}

void containers_of_bases() {
  Pose pose = {3, 4};
  SSMApi<Pose> writer("poly", 1);
  writer.create(1.0, 0.1);
  writer.data = pose;
  writer.write(1.5);
  std::list<SSMApiBase*> all;
  all.push_back(new SSMApi<Pose>("poly", 1));
  all.push_back(new SSMApi<Pose, ScanProperty>("poly", 1));
  for (std::list<SSMApiBase*>::iterator it = all.begin(); it != all.end(); ++it) {
    SSMApiBase* api = *it;
    CHECK(api->open() && api->readLast() && api->readTime(2.0));
    CHECK_SAME((*static_cast<Pose*>(api->data())).y, 4);
    CHECK(std::string(api->getStreamName()) == "poly");
    CHECK(api->getSSMId() != 0);
    delete api;
  }
}

class Player {
 public:
  explicit Player(const std::string& stream) : api(stream.c_str(), 2), buffer() {}
  SSMApiBase api;
  Pose buffer;
};

void copies() {
  SSMApi<Pose> writer("copied", 2);
  writer.create(1.0, 0.1);
  writer.data.x = 8;
  writer.write(1.0);
  std::vector<Player> players;
  for (int i = 0; i < 10; ++i) players.push_back(Player("copied"));
  for (size_t i = 0; i < players.size(); ++i) {
    Player& player = players[i];
    player.api.setBuffer(&player.buffer, sizeof(player.buffer), NULL, 0);
    CHECK(player.api.open() && player.api.readLast());
    CHECK_SAME(player.buffer.x, 8);
  }
  SSMApi<Pose> first("copied", 2);
  first.data.x = 1;
  SSMApi<Pose> second(first), third;
  third = first;
  CHECK(second.SSMApiBase::data() == &second.data && third.SSMApiBase::data() == &third.data);
  CHECK(second.open() && second.readLast() && third.open() && third.readLast());
  CHECK_SAME(first.data.x, 1);  // copies read into themselves
  CHECK_SAME(second.data.x, 8);
  static SSMApi<image> image1("copied", 3), image2(image1);  // arrays too
  CHECK(image2.SSMApiBase::data() == &image2.data);
}

void static_objects() {
  CHECK(std::string(static_api.getStreamName()) == "static");
  CHECK_SAME(static_api.data.x, 0);  // static: zero
  CHECK(static_api.create(1.0, 0.1) && static_api.write(1.0) && static_api.readLast());
}

void kept_addresses() {
  SSMApi<Pose> writer("kept", 0), reader("kept", 0);
  const Pose* const kept = &reader.data;
  const ssmTimeT* const kept_time = &reader.time;
  writer.create(1.0, 0.1);
  reader.open();
  for (int i = 0; i < 30; ++i) {
    writer.data.x = i;
    writer.write(i + 1);
    CHECK(reader.readNew());
    CHECK_SAME(kept->x, i);
    CHECK_SAME(*kept_time, i + 1);
    CHECK(kept == &reader.data);
  }
}

void names_are_copied() {
  SSMApi<Pose> api;
  CHECK(std::string(api.getStreamName()) == "");
  {
    std::string gone = "gone_name";
    catch_stderr();
    api.open(gone.c_str(), 1);
    caught_stderr();
    gone = "overwritten";
  }
  CHECK(std::string(api.getStreamName()) == "gone_name");
  catch_stderr();
  CHECK(!api.create(NULL, 1, 1.0, 0.1));
  CHECK_TEXT(caught_stderr(), "NULL");
  CHECK(std::string(api.getStreamName()) == "");
  catch_stderr();
  CHECK(!api.create(std::string(100, 'n').c_str(), 1, 1.0, 0.1));  // too long stays too long
  caught_stderr();
}

void results_as_numbers() {
  SSMApi<Pose> api("numbers", 0);
  api.create(1.0, 0.1);
  int result = api.openWait(0.1);
  CHECK(!(result != 1));
  catch_stderr();
  std::cerr << api.release();
  CHECK(std::string(caught_stderr()) == "1");
}

void polled_top() {
  SSMApi<Pose> api("polled", 0);
  api.create(1.0, 0.1);
  SSM_tid seen = getTID_top(api.getSSMId());
  CHECK_EQUAL(seen, -1);
  for (int i = 0; i < 5; ++i) {
    api.write(i + 1);
    CHECK(getTID_top(api.getSSMId()) > seen);
    seen = getTID_top(api.getSSMId());
  }
  CHECK_EQUAL(seen, 4);
}

void tid_zero_mistaken_for_nothing() {
  SSMApi<Pose> api("zero", 0);
  api.create(1.0, 0.1);
  Pose pose;
  api.write(1.0);
  CHECK_EQUAL(readSSM(api.getSSMId(), &pose, NULL, -1), 0);
  api.write(2.0);
  int rounds = 0;
  while (readSSM(api.getSSMId(), &pose, NULL, -1) <= 0) ++rounds;
  CHECK_EQUAL(rounds, 0);
}

void two_on_one_stream() {
  SSMApi<Pose> a("both", 0), b("both", 0);
  CHECK(a.create(1.0, 0.1) && b.create(1.0, 0.1));
  a.data.x = 1;
  b.data.x = 2;
  CHECK(a.write(1.0) && b.write(2.0) && a.write(3.0));
  CHECK_EQUAL(a.timeId, 2);
  CHECK_EQUAL(b.timeId, 1);
  CHECK(a.read(1));
  CHECK_SAME(a.data.x, 2);
  CHECK(a.close() && b.isOpen() && b.read(2));
  CHECK_SAME(b.data.x, 1);
}

void own_names() {
  ctrlC(0);
  setSigInt();
  node a = {1};
  edge b = {2};
  CHECK(gShutOff && a.a == 1 && b.b == 2 && get_unit(PI) == ' ');
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  CHECK_EQUAL(initSSM(), 1);
  anything_as_type();
  huge_on_the_stack();
  subclasses_with_callbacks();
  exceptions_from_callbacks();
  exceptions_while_writing();
  containers_of_bases();
  copies();
  static_objects();
  kept_addresses();
  names_are_copied();
  results_as_numbers();
  polled_top();
  tid_zero_mistaken_for_nothing();
  two_on_one_stream();
  own_names();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
