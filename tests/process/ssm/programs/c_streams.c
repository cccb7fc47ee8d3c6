/* SPDX-License-Identifier: Apache-2.0
 *
 * The C interface without samples: registration, creating and opening, information, properties,
 * nodes and edges.
 */
#include <libssm.h>

#include "check.h"

typedef struct {
  double x;
  int n;
} Sample;

static int edge_count(const char *wanted) {
  char name[SSM_SNAME_MAX];
  int i, id, from, to, mode, count = 0;
  for (i = 0; getSSM_edge_info(i, name, sizeof(name), &id, &from, &to, &mode); ++i) {
    if (strcmp(name, wanted) == 0) ++count;
  }
  return count;
}

static void before_init(void) {
  SSM_sid sid;
  char name[SSM_SNAME_MAX];
  int id;
  size_t size;
  CHECK_EQUAL(getSSM_num(), -1);
  CHECK_EQUAL(getSSM_node_num(), -1);
  CHECK_EQUAL(getSSM_edge_num(), -1);
  CHECK_EQUAL(getSSM_name(0, name, &id, &size), -1);
  CHECK(openSSM("anything", 0, 0) == 0);
  catch_stderr();
  sid = createSSM("anything", 0, 8, 1.0, 0.1);
  CHECK_TEXT(caught_stderr(), "initSSM");
  CHECK(sid == 0);
  CHECK(timecontrol == NULL);
  CHECK_EQUAL(endSSM(), 0); /* nobody to tell: never registered */
}

static void no_coordinator(const char *real_socket) {
  int result;
  setenv("DSSM_SOCKET", "/nonexistent/dssmd.sock", 1);
  catch_stderr();
  result = initSSM();
  CHECK_TEXT(caught_stderr(), "/nonexistent/dssmd.sock");
  CHECK_EQUAL(result, 0);
  catch_stderr();
  errSSM();
  CHECK_TEXT(caught_stderr(), "SSM Err: ");
  setenv("DSSM_SOCKET", real_socket, 1);
}

static void refuse_create(const char *name, int id, double life, double cycle, const char *word) {
  SSM_sid sid;
  catch_stderr();
  sid = createSSM(name, id, sizeof(Sample), life, cycle);
  CHECK_TEXT(caught_stderr(), word);
  CHECK(sid == 0);
}

static void create_arguments(void) {
  const char *name31 = "1234567890123456789012345678901";
  const char *name32 = "12345678901234567890123456789012";
  SSM_sid sid;
  refuse_create(NULL, 0, 1, 0.1, "NULL");
  refuse_create("", 0, 1, 0.1, "name");
  refuse_create(name32, 0, 1, 0.1, name32);
  refuse_create("args", -1, 1, 0.1, "id");
  refuse_create("args", 0, 0, 0.1, "life");
  refuse_create("args", 0, -1, 0.1, "life");
  refuse_create("args", 0, 1, 0, "cycle");
  refuse_create("args", 0, 1, -0.1, "cycle");
  refuse_create("args", 0, 0.1, 0.2, "cycle");
  refuse_create("args", 0, 1e9, 1e-6, "life");
  CHECK_EQUAL(getSSM_info("args", 0, NULL, NULL, NULL, NULL), -1); /* none of them left a trace */

  sid = createSSM(name31, 2147483647, sizeof(Sample), 0.1, 0.1);
  CHECK(sid != 0);
  CHECK(releaseSSM(&sid) == 1 && sid == 0);
  CHECK(openSSM(name32, 0, 0) == 0);
  CHECK(openSSM(NULL, 0, 0) == 0);
  CHECK(openSSM(name31, -1, 0) == 0);
  sid = openSSM(name31, 2147483647, SSM_READ);
  CHECK(sid != 0);
  CHECK(closeSSM(&sid) == 1 && sid == 0);
  CHECK(closeSSM(&sid) == 1 && sid == 0); /* closing twice is no error */
  CHECK(releaseSSM(&sid) == 1);
}

/* A replayed stream has as many slots as the recorded one; once every sixth had one less. */
static void ring_sizes_come_back(void) {
  static const double cycles[] = {0.001, 0.005, 0.0333, 0.05, 0.1, 1};
  unsigned i;
  int num;
  for (i = 0; i < sizeof(cycles) / sizeof(cycles[0]); ++i) {
    for (num = 2; num < 2000; ++num) {
      CHECK_EQUAL(calcSSM_table(calcSSM_life(num, cycles[i]), cycles[i]), num);
    }
  }
}

static void ring_sizes(void) {
  static const struct {
    double life, cycle;
    int num;
  } known[] = {{1, 0.1, 13}, {5, 0.005, 1201}, {0.1, 0.1, 2}, {2, 0.05, 49}, {5, 0.05, 121}};
  unsigned i;
  for (i = 0; i < sizeof(known) / sizeof(known[0]); ++i) {
    SSM_sid sid;
    size_t size = 0, property = 99;
    int num = 0, id = 0;
    double cycle = 0;
    char name[SSM_SNAME_MAX];
    CHECK_EQUAL(calcSSM_table(known[i].life, known[i].cycle), known[i].num);
    CHECK_SAME(calcSSM_life(known[i].num, known[i].cycle),
               (known[i].num - 1) * known[i].cycle / 1.2);
    sprintf(name, "ring%u", i);
    sid = createSSM(name, 7, sizeof(Sample), known[i].life, known[i].cycle);
    CHECK(sid != 0);
    CHECK_EQUAL(getSSM_info(name, 7, &size, &num, &cycle, &property), (long)sizeof(Sample));
    CHECK_EQUAL((long)size, (long)sizeof(Sample));
    CHECK_EQUAL(num, known[i].num);
    CHECK_SAME(cycle, known[i].cycle);
    CHECK_EQUAL((long)property, 0);
    CHECK_EQUAL((long)shm_get_address(sid)->size, (long)sizeof(Sample));
    CHECK_EQUAL(shm_get_address(sid)->num, known[i].num);
    CHECK_SAME(shm_get_address(sid)->cycle, known[i].cycle);
    CHECK_EQUAL(shm_get_address(sid)->tid_top, -1);
    CHECK_EQUAL((long)shm_get_data_size(shm_get_address(sid)), (long)sizeof(Sample));
    releaseSSM(&sid);
    CHECK(shm_get_address(sid) == NULL);
    CHECK_EQUAL(getSSM_info(name, 7, NULL, NULL, NULL, NULL), (long)sizeof(Sample));
    (void)id;
  }
  CHECK_EQUAL(getSSM_info("ring0", 8, NULL, NULL, NULL, NULL), -1);
  CHECK_EQUAL(getSSM_info("12345678901234567890123456789012", 0, NULL, NULL, NULL, NULL), -1);
  CHECK_EQUAL(getSSM_info("123456789012345678901234567890123", 0, NULL, NULL, NULL, NULL), 0);
}

static void create_again(void) {
  Sample in, out;
  ssmTimeT time = 0;
  SSM_sid first, second, other;
  int i, num = 0;
  memset(&in, 0, sizeof(in));
  first = createSSM("again", 0, sizeof(Sample), 1, 0.1);
  for (i = 0; i < 5; ++i) {
    in.n = i;
    CHECK_EQUAL(writeSSM(first, &in, 100.5 + i), i);
  }
  second = createSSM_time("again", 0, sizeof(Sample), 2, 0.05); /* other life: the ring stays */
  CHECK(second != 0);
  getSSM_info("again", 0, NULL, &num, NULL, NULL);
  CHECK_EQUAL(num, 13);
  for (i = 0; i < 5; ++i) { /* and so do the samples, with their times */
    CHECK_EQUAL(readSSM(second, &out, &time, i), i);
    CHECK_EQUAL(out.n, i);
    CHECK_SAME(time, 100.5 + i);
  }
  CHECK_EQUAL(writeSSM(second, &in, 200), 5); /* tids go on */
  CHECK_EQUAL(writeSSM(first, &in, 201), 6);
  catch_stderr();
  other = createSSM("again", 0, 4096, 1, 0.1); /* another size would corrupt memory */
  CHECK_TEXT(caught_stderr(), "4096");
  CHECK(other == 0);
  CHECK_EQUAL(getTID_top(first), 6);
  releaseSSM(&first);
  CHECK_EQUAL(getTID_top(second), 6);
  releaseSSM(&second);
  second = openSSM("again", 0, 0); /* the stream survives its creators */
  CHECK_EQUAL(getTID_top(second), 6);
  closeSSM(&second);
}

static void size_zero(void) {
  SSM_sid sid, wrong;
  size_t size = 99;
  char untouched = 'u';
  ssmTimeT time = 0;
  sid = createSSM("empty", 0, 0, 1, 0.1);
  CHECK(sid != 0);
  CHECK_EQUAL(getSSM_info("empty", 0, &size, NULL, NULL, NULL), 0);
  CHECK_EQUAL((long)size, 0);
  CHECK_EQUAL((long)shm_get_address(sid)->size, 0);
  CHECK_EQUAL(writeSSM(sid, NULL, 12.5), 0);
  CHECK_EQUAL(readSSM(sid, &untouched, &time, -1), 0);
  CHECK_EQUAL(untouched, 'u');
  CHECK_SAME(time, 12.5);
  catch_stderr();
  wrong = createSSM("empty", 0, 1, 1, 0.1);
  CHECK_TEXT(caught_stderr(), "empty");
  CHECK(wrong == 0);
  releaseSSM(&sid);
}

static void listing(void) {
  SSM_sid first, second;
  char name[SSM_SNAME_MAX];
  int id = 0, n = getSSM_num();
  size_t size = 0;
  CHECK(n > 0);
  first = createSSM("list_b", 3, 24, 1, 0.1);
  second = createSSM("list_a", 1, 40, 1, 0.1);
  CHECK_EQUAL(getSSM_num(), n + 2);
  CHECK_EQUAL(getSSM_name(n, name, &id, &size), 24); /* in the order of creation */
  CHECK(strcmp(name, "list_b") == 0 && id == 3 && size == 24);
  CHECK_EQUAL(getSSM_name(n + 1, name, NULL, NULL), 40);
  CHECK(strcmp(name, "list_a") == 0);
  CHECK_EQUAL(getSSM_name(n, NULL, NULL, NULL), 24);
  CHECK_EQUAL(getSSM_name(n + 2, name, &id, &size), -1);
  CHECK_EQUAL(getSSM_name(-1, name, &id, &size), -1);
  releaseSSM(&first);
  releaseSSM(&second);
  CHECK_EQUAL(getSSM_num(), n + 2);
}

static void properties(void) {
  static char big[1 << 20], back[1 << 20];
  size_t size = 0, i;
  int numbers[2];
  SSM_sid sid;
  numbers[0] = 11;
  numbers[1] = 22;
  CHECK_EQUAL(set_propertySSM("nobody", 0, numbers, sizeof(numbers)), 0); /* no such stream */
  CHECK_EQUAL(get_propertySSM("nobody", 0, numbers), 0);
  sid = createSSM("prop", 0, 8, 1, 0.1);
  CHECK_EQUAL(get_propertySSM("prop", 0, numbers), 0); /* none set */
  CHECK_EQUAL(numbers[0], 11);
  CHECK_EQUAL(set_propertySSM("prop", 0, numbers, sizeof(numbers)), 1);
  numbers[0] = numbers[1] = 0;
  CHECK_EQUAL(get_propertySSM("prop", 0, numbers), 1);
  CHECK(numbers[0] == 11 && numbers[1] == 22);
  for (i = 0; i < sizeof(big); ++i) big[i] = (char)(i * 7); /* over 8192 bytes: hung the old one */
  CHECK_EQUAL(set_propertySSM("prop", 0, big, sizeof(big)), 1);
  getSSM_info("prop", 0, NULL, NULL, NULL, &size);
  CHECK_EQUAL((long)size, (long)sizeof(big));
  CHECK_EQUAL(get_propertySSM("prop", 0, back), 1);
  CHECK(memcmp(big, back, sizeof(big)) == 0);
  CHECK_EQUAL(set_propertySSM("prop", 0, "abc", 3), 1); /* smaller again: the length follows */
  getSSM_info("prop", 0, NULL, NULL, NULL, &size);
  CHECK_EQUAL((long)size, 3);
  memset(back, 'x', 8);
  CHECK_EQUAL(get_propertySSM("prop", 0, back), 1);
  CHECK(memcmp(back, "abcxxxxx", 8) == 0);
  CHECK_EQUAL(set_propertySSM("123456789012345678901234567890123", 0, "a", 1), 0);
  CHECK_EQUAL(set_propertySSM("prop", 0, "", 0), 1); /* size 0: none; hung the old one */
  CHECK_EQUAL(get_propertySSM("prop", 0, back), 0);
  releaseSSM(&sid);
}

static void nodes_and_edges(void) {
  SSM_sid writer, reader, updater;
  char name[SSM_SNAME_MAX], tiny[4];
  int i, id, from, to, mode, node = 0, found = 0, edges;
  CHECK_EQUAL(initSSM(), 1); /* a process counts once however often it registers */
  CHECK_EQUAL(getSSM_node_num(), 1);
  CHECK_EQUAL(getSSM_node_info(0, &node), 1);
  CHECK_EQUAL(node, getpid());
  CHECK_EQUAL(getSSM_node_info(1, &node), 0);
  CHECK_EQUAL(getSSM_node_info(-1, &node), 0);
  edges = getSSM_edge_num();
  writer = createSSM("edges", 4, 8, 1, 0.1); /* creating makes no edge */
  CHECK_EQUAL(getSSM_edge_num(), edges);
  reader = openSSM("edges", 4, SSM_READ);
  updater = openSSM("edges", 4, SSM_WRITE);
  CHECK_EQUAL(getSSM_edge_num(), edges + 2);
  for (i = 0; getSSM_edge_info(i, name, sizeof(name), &id, &from, &to, &mode); ++i) {
    if (strcmp(name, "edges") != 0) continue;
    CHECK_EQUAL(id, 4);
    CHECK_EQUAL(from, getpid());
    CHECK_EQUAL(to, getpid());
    CHECK_EQUAL(mode, found == 0 ? SSM_READ : SSM_WRITE);
    ++found;
  }
  CHECK_EQUAL(found, 2);
  CHECK_EQUAL(getSSM_edge_info(edges, tiny, sizeof(tiny), NULL, NULL, NULL, NULL), 1);
  CHECK(strcmp(tiny, "edg") == 0);
  CHECK_EQUAL(getSSM_edge_info(1000, name, sizeof(name), &id, &from, &to, &mode), 0);
  i = 5;
  CHECK_EQUAL(writeSSM(updater, "12345678", 1.0), 0); /* a mode restricts nothing */
  CHECK_EQUAL(writeSSM(reader, "12345678", 2.0), 1);
  CHECK_EQUAL(getTID_top(writer), 1);
  CHECK_EQUAL(edge_count("edges"), 2); /* nor do the second ends of sids make edges */
  closeSSM(&reader);
  closeSSM(&updater);
  releaseSSM(&writer);
}

static void harmless_leftovers(void) {
  char buffer[4] = {'a', 'b', 'c', 'd'};
  CHECK_EQUAL(damp(0, 1, 2), 0);
  CHECK_EQUAL(add_info("x", 1, 8080), 0);
  CHECK_EQUAL(get_info_size(), 0);
  CHECK_EQUAL(get_info(buffer, sizeof(buffer)), 0);
  CHECK_EQUAL(buffer[0], 'a');
}

static void after_end(void) {
  Sample in, out;
  SSM_sid made, opened;
  memset(&in, 0, sizeof(in));
  in.n = 5;
  made = createSSM("ended", 0, sizeof(Sample), 1, 0.1);
  opened = openSSM("ended", 0, SSM_READ);
  CHECK_EQUAL(endSSM(), 1);
  CHECK_EQUAL(endSSM(), 1); /* twice is harmless */
  CHECK(timecontrol == NULL);
  CHECK_EQUAL(getSSM_num(), -1);
  CHECK(openSSM("ended", 0, 0) == 0);
  /* Open sids stay usable, also in the direction that they were not used in yet. */
  CHECK_EQUAL(writeSSM(opened, &in, 1.0), 0);
  CHECK_EQUAL(readSSM(made, &out, NULL, -1), 0);
  CHECK_EQUAL(out.n, 5);
  CHECK_EQUAL(writeSSM(made, &in, 2.0), 1);
  CHECK_EQUAL(getTID_top(opened), 1);
  CHECK_EQUAL(initSSM(), 1);
  CHECK_EQUAL(getTID_top(opened), 1);
  closeSSM(&opened);
  releaseSSM(&made);
  CHECK_EQUAL(getSSM_node_num(), 1);
}

int main(int argc, char **argv) {
  char socket[300];
  check_begin(argc, argv);
  strcpy(socket, getenv("DSSM_SOCKET"));
  before_init();
  no_coordinator(socket);
  CHECK_EQUAL(initSSM(), 1);
  CHECK_EQUAL(initSSM(), 1);
  CHECK(timecontrol != NULL);
  create_arguments();
  ring_sizes();
  ring_sizes_come_back();
  create_again();
  size_zero();
  listing();
  properties();
  nodes_and_edges();
  harmless_leftovers();
  after_end();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
