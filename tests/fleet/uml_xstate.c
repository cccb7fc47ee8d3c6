// SPDX-License-Identifier: Apache-2.0
//
// Lets Linux 6.1's User Mode Linux run on processors whose register state is larger than its buffer.
//
// User Mode Linux sets the vector registers of a guest's process by ptrace(PTRACE_SETREGSET,
// NT_X86_XSTATE) from a buffer of a fixed size. Linux accepts only the whole state, which is larger
// with AMX, and returns EFAULT otherwise; the guest's init dies at its first instruction ("ptrace set fp
// regs failed, errno = 14"). Preloaded (LD_PRELOAD), this library extends such a request to the full
// size. The added bytes are zero and belong to registers that no guest can enable, so nothing is lost.
//
// If the state is not larger than UML's buffer, the request is passed on unchanged; Linux itself
// truncates one that is too long.
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

enum { kMaxBytes = 64 * 1024 };

static long (*real_ptrace)(int request, ...);

__attribute__((constructor)) static void find_real_ptrace(void) {
  *(void**)&real_ptrace = dlsym(RTLD_NEXT, "ptrace");
}

// Static, because UML's stacks are small; it runs its kernel in one thread.
static _Alignas(64) unsigned char whole[kMaxBytes];
static size_t whole_bytes;  // of this machine's register state; 0: not known yet

static long set_registers(void* pid, const struct iovec* given) {
  if (whole_bytes == 0) {
    struct iovec ask = {whole, sizeof whole};
    if (real_ptrace(PTRACE_GETREGSET, pid, (void*)NT_X86_XSTATE, &ask) != 0) return -1;
    whole_bytes = ask.iov_len;
    memset(whole, 0, sizeof whole);
  }
  struct iovec all = *given;
  if (given->iov_len < whole_bytes) {
    memcpy(whole, given->iov_base, given->iov_len);
    all = (struct iovec){whole, whole_bytes};
  }
  return real_ptrace(PTRACE_SETREGSET, pid, (void*)NT_X86_XSTATE, &all);
}

long ptrace(enum __ptrace_request request, ...) {
  va_list arguments;
  va_start(arguments, request);
  void* pid = va_arg(arguments, void*);
  void* address = va_arg(arguments, void*);
  void* data = va_arg(arguments, void*);
  va_end(arguments);
  if (request == PTRACE_SETREGSET && address == (void*)NT_X86_XSTATE) {
    return set_registers(pid, data);
  }
  return real_ptrace((int)request, pid, address, data);
}
