/* SPDX-License-Identifier: Apache-2.0
 *
 * Checks for programs in the style of old SSM programs: plain C of 1989, so that every dialect takes
 * it. A check that fails prints where and goes on; main() ends with `return check_result();`.
 * What the library prints to stderr is caught between catch_stderr() and caught_stderr(), in the
 * folder given as the program's first argument.
 */
#ifndef TESTS_SSM_CHECK_H
#define TESTS_SSM_CHECK_H

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define CHECK_HELPER __attribute__((unused))

static int check_failures = 0;
static int check_count = 0;

CHECK_HELPER static void check_failed(const char *file, int line, const char *what) {
  ++check_failures;
  printf("%s:%d: failed: %s\n", file, line, what);
}

CHECK_HELPER static void check_that(int good, const char *file, int line, const char *what) {
  ++check_count;
  if (!good) check_failed(file, line, what);
}

CHECK_HELPER static void check_equal(long a, long b, const char *file, int line, const char *what) {
  ++check_count;
  if (a == b) return;
  check_failed(file, line, what);
  printf("    %ld is not %ld\n", a, b);
}

CHECK_HELPER static void check_same(double a, double b, const char *file, int line, const char *what) {
  ++check_count;
  if (!(a < b) && !(b < a)) return;
  check_failed(file, line, what);
  printf("    %.9f is not %.9f\n", a, b);
}

CHECK_HELPER static void check_text(const char *text, const char *part, const char *file, int line) {
  ++check_count;
  if (strstr(text, part)) return;
  check_failed(file, line, part);
  printf("    not in: %s\n", text);
}

#define CHECK(condition) check_that((condition) ? 1 : 0, __FILE__, __LINE__, #condition)
#define CHECK_EQUAL(a, b) check_equal((a), (b), __FILE__, __LINE__, #a " == " #b)
#define CHECK_SAME(a, b) check_same((a), (b), __FILE__, __LINE__, #a " == " #b) /* doubles */
#define CHECK_TEXT(text, part) check_text((text), (part), __FILE__, __LINE__)

static char check_folder[256];
static int check_stderr = -1;
static char check_text_buffer[16384];

CHECK_HELPER static void check_begin(int argc, char **argv) {
  if (argc < 2 || strlen(argv[1]) > sizeof(check_folder) - 16) {
    printf("usage: %s FOLDER\n", argv[0]);
    exit(2);
  }
  strcpy(check_folder, argv[1]);
  setvbuf(stdout, NULL, _IOLBF, 0); /* what was found before a crash or a hang is seen */
}

CHECK_HELPER static void catch_stderr(void) {
  char path[300];
  int file;
  sprintf(path, "%s/stderr", check_folder);
  fflush(stderr);
  check_stderr = dup(2);
  file = open(path, O_CREAT | O_TRUNC | O_RDWR, 0600);
  dup2(file, 2);
  close(file);
}

CHECK_HELPER static const char *caught_stderr(void) {
  ssize_t length;
  fflush(stderr);
  lseek(2, 0, SEEK_SET);
  length = read(2, check_text_buffer, sizeof(check_text_buffer) - 1);
  check_text_buffer[length > 0 ? length : 0] = '\0';
  dup2(check_stderr, 2);
  close(check_stderr);
  return check_text_buffer;
}

CHECK_HELPER static int check_result(void) {
  printf("%d checks, %d failed\n", check_count, check_failures);
  return check_failures ? 1 : 0;
}

#endif
