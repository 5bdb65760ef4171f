/* LLVM for tests: it optimizes little, because tests compile many kernels and run each for a moment.
 *
 * Dr.Jit looks its compiler's functions up in one library. Built into a library that links to LLVM, those below come
 * before LLVM's own, which they call. LLVM is the file LLVM_LIBRARY, a definition of the build.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <string.h>

static void *of_llvm(const char *name) {
    return dlsym(dlopen(LLVM_LIBRARY, RTLD_LAZY | RTLD_NOLOAD), name);
}

/* Optimize neither the program, for which Dr.Jit asks for default<O2>, … */
void *LLVMRunPasses(void *module, const char *passes, void *machine, void *options) {
    void *(*original)(void *, const char *, void *, void *) = of_llvm("LLVMRunPasses");
    (void)passes;
    return original(module, "default<O0>", machine, options);
}

/* … nor its machine code much. Level 0 compiles no faster, and its code runs twice as long. */
void *LLVMCreateTargetMachine(void *target, const char *triple, const char *cpu, const char *features, int level,
                              int relocation, int code_model) {
    void *(*original)(void *, const char *, const char *, const char *, int, int, int) =
        of_llvm("LLVMCreateTargetMachine");
    (void)level;
    return original(target, triple, cpu, features, 1, relocation, code_model);
}

/* Without AVX, Dr.Jit compiles for 4 lanes in place of 8: half the code for as many lines of a kernel. */
char *LLVMGetHostCPUFeatures(void) {
    char *(*original)(void) = of_llvm("LLVMGetHostCPUFeatures");
    char *features = original();
    for (char *found = features; (found = strstr(found, "+avx")) != NULL;)
        *found = '-';
    return features;
}
