/* Calls kernels of a library of `shared/native` on a processor of its own: call_kernels LIBRARY CALLS RESULTS.

   CALLS: 64-bit integers: how many calls there are; of each, the length of the symbol and its characters; the number of slots of
   the block and the slots; the number of arrays; of each array, the slot that is to point to it, its size in bytes and its
   bytes. RESULTS: of each call what it returned (64 bits), and the bytes of all its arrays. */
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

static int64_t number(FILE *file) {
  int64_t found;
  if (fread(&found, sizeof found, 1, file) != 1) exit(3);
  return found;
}

static void *bytes(FILE *file, int64_t size) {
  void *found = NULL;
  if (posix_memalign(&found, 64, size + 1) || fread(found, 1, size, file) != (size_t)size) exit(3);
  return found;
}

int main(int count, char **words) {
  void *library = count == 4 ? dlopen(words[1], RTLD_NOW) : NULL;
  FILE *calls = library ? fopen(words[2], "rb") : NULL, *results = calls ? fopen(words[3], "wb") : NULL;
  if (!results) {
    fprintf(stderr, "call_kernels: %s\n", library ? "a file does not open" : dlerror());
    return 2;
  }
  for (int64_t left = number(calls); left > 0; left--) {
    int64_t length = number(calls);
    char *symbol = bytes(calls, length);
    symbol[length] = 0;
    int64_t slots = number(calls), *block = bytes(calls, slots * sizeof *block), arrays = number(calls);
    int64_t *sizes = malloc(arrays * sizeof *sizes);
    void **data = malloc(arrays * sizeof *data); /* an array object is its first field here: the address of the data */
    for (int64_t i = 0; i < arrays; i++) {
      int64_t slot = number(calls);
      sizes[i] = number(calls);
      data[i] = bytes(calls, sizes[i]);
      block[slot] = (int64_t)(data + i);
    }
    int (*kernel)(const int64_t *) = (int (*)(const int64_t *))dlsym(library, symbol);
    if (!kernel) {
      fprintf(stderr, "call_kernels: no %s in %s\n", symbol, words[1]);
      return 2;
    }
    int64_t failed = kernel(block);
    fwrite(&failed, sizeof failed, 1, results);
    for (int64_t i = 0; i < arrays; i++) {
      fwrite(data[i], 1, sizes[i], results);
      free(data[i]);
    }
    free(data), free(sizes), free(block), free(symbol);
  }
  return fclose(results) ? 2 : 0;
}
